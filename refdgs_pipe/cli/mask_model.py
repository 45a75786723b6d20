"""The user's own network for masks: noted by its path, known by its content."""

import os
from collections.abc import Mapping
from pathlib import Path
from threading import Event

from refdgs_pipe import recipe
from refdgs_pipe.errors import CaptureError, InputError
from refdgs_pipe.masking.onnx_file import check_size
from refdgs_pipe.masking.settings import MasksParams
from refdgs_pipe.params import Params
from refdgs_pipe.pipeline.fingerprint import fingerprint
from refdgs_pipe.pipeline.store import Store

STAGE = "masks"
MEMORY = ".mask-model.json"  # saves hashing an unchanged file again


def assignment(file: str) -> str:
    """What `--mask-model FILE` sets; an empty name sets that there is none.

    Raises:
        InputError: there is no such file, or it is too large.
    """
    if file:
        file = os.path.normpath(Path.cwd() / file)
        check_size(Path(file))
    return recipe.assignment(f"{STAGE}.model", file)


def with_digest(settings: dict[str, Params], store: Store) -> dict[str, Params]:
    """The settings, with the hash of the network's file as it is now.

    A file that is gone counts as it was when the workspace's masks were made by one of its name.

    Raises:
        InputError: it is gone and never made masks here, or cannot be a network.
    """
    params = settings.get(STAGE)
    if not isinstance(params, MasksParams) or not params.model:
        return settings
    file = Path(params.model)
    last = store.current(STAGE)
    used = {value for name, value, _ in last.measures if name == "network"} if last else set()
    if last and file.name in used and not file.exists():
        digest = str(last.origin.params["model"])
    else:
        digest = _digest(file, store)
    return settings | {STAGE: params.model_copy(update={"model_digest": digest})}


def check(settings: Mapping[str, Params], stop: Event) -> None:
    """Try the network, if there is one, before hours of other work.

    Raises:
        InputError: it cannot be used.
        Cancelled: `stop` was set.
    """
    params = settings.get(STAGE)
    if isinstance(params, MasksParams) and params.model and params.find != "off":
        from refdgs_pipe.masking.by_network import check_network
        from refdgs_pipe.masking.network import Network

        check_network(Network.of(params), stop=stop)


def _digest(file: Path, store: Store) -> str:
    check_size(file)
    try:
        return fingerprint([(str(file), file)], store.root / MEMORY).files[str(file)]
    except CaptureError as error:
        raise InputError(f"{error}. Give another file with --mask-model") from None
