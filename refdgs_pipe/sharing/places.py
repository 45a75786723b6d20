"""Where results are shared: a bucket or a folder, by the name that the user gave."""

import os
import re
from datetime import timedelta
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from refdgs_pipe.errors import DiskFault, InputError
from refdgs_pipe.formatting import printable
from refdgs_pipe.sharing.objects import RECORDS, Objects, store_errors

_URL = re.compile(r"(s3|gs|az)://[A-Za-z0-9][A-Za-z0-9._-]*(/[^?#\\]*)?")
# one file may take long, a connection or a silence may not
_CLIENT = {"timeout": "3600s", "connect_timeout": "10s", "read_timeout": "60s"}
_RETRY = {"max_retries": 5, "retry_timeout": timedelta(seconds=60)}


def check_place(place: str) -> str:
    """The name of a place, made absolute where it is a folder.

    Raises:
        InputError: it is none that we know.
    """
    if "://" not in place:
        if not place.strip():
            raise InputError("--cache: expected s3://, gs:// or az:// with a bucket, or a folder")
        return str(Path.cwd() / place)
    if not _URL.fullmatch(place) or ".." in place.split("/"):
        raise InputError(
            f"--cache {printable(place)}: expected s3://BUCKET/PREFIX, gs://BUCKET/PREFIX, "
            "az://CONTAINER/PREFIX or a folder. Keys and passwords belong into the environment"
        )
    return place.rstrip("/")


def open_place(place: str, *, make: bool = False) -> Objects:
    """The shared results at a place. Nothing is asked of it yet.

    Credentials come from the standard environment variables or the machine's own role.

    Args:
        make: make the folder if only it is missing.

    Raises:
        InputError: it is none that we know, obstore is not installed, or a variable is wrong.
        DiskFault: the folder is not there.
    """
    place = check_place(place)
    if "://" not in place and not (Path(place).parent if make else Path(place)).is_dir():
        raise DiskFault(f"--cache {printable(place)}: no such folder here. Mount it, or make it")
    if find_spec("obstore") is None:
        raise InputError("--cache needs obstore: pip install obstore (extra: batch)")
    return Objects(_store(place), place)


def look_at(place: str) -> Objects:
    """`open_place`, after one request that says whether it can be used.

    Raises:
        InputError: as `open_place`, or it may not be read.
        DiskFault: it cannot be reached.
    """
    found = open_place(place, make=True)
    from obstore.exceptions import PermissionDeniedError, UnauthenticatedError

    with store_errors(found.place):
        try:
            next(iter(found.store.list(RECORDS, chunk_size=1)), None)
        except FileNotFoundError:
            raise InputError(f"--cache {printable(place)}: there is none. Make it first") from None
        except (PermissionDeniedError, UnauthenticatedError) as error:
            words = printable(str(error).splitlines()[0])
            raise InputError(f"--cache {printable(place)}: access is refused ({words})") from None
    return found


def _store(place: str) -> Any:
    from obstore.exceptions import BaseError
    from obstore.store import AzureStore, GCSStore, LocalStore, S3Store

    kinds = {"s3": S3Store, "gs": GCSStore, "az": AzureStore}
    scheme = place.partition("://")[0] if "://" in place else ""
    try:
        if not scheme:
            return LocalStore(place, mkdir=True)
        plain = os.environ.get("AWS_ALLOW_HTTP", "").lower() in ("1", "true")
        client = _CLIENT | {"allow_http": plain}  # a server of one's own may speak no TLS
        return kinds[scheme].from_url(place, client_options=client, retry_config=_RETRY)
    except (BaseError, ValueError, OSError) as error:
        first = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise InputError(f"--cache {printable(place)}: {printable(first)}") from None
