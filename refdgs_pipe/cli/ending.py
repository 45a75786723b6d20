"""How a command ends: its exit code, one message, and a log only for what is a bug of ours."""

import io
import os
import sys
from typing import NoReturn

import typer

from refdgs_pipe.cli.device import let_waiting_threads_sleep
from refdgs_pipe.cli.logs import keep_traceback
from refdgs_pipe.documents import write_json_text
from refdgs_pipe.errors import Cancelled, RefdgsError
from refdgs_pipe.formatting import printable_lines
from refdgs_pipe.trouble import explained


def end_with(app: typer.Typer) -> NoReturn:
    """Run a command line. Errors meant for users have no traceback; others go to a log."""
    let_waiting_threads_sleep()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):  # a path that is not UTF-8 goes out as it is
            stream.reconfigure(errors="surrogateescape" if stream is sys.stdout else None)
    try:
        code = app(prog_name="refdgs-pipe", standalone_mode=False)
    except (typer.Abort, KeyboardInterrupt):
        code = Cancelled.exit_code
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except Exception as error:
        if found := explained(error):
            _end(found)
        show, wrong = getattr(error, "show", None), getattr(error, "exit_code", None)
        if callable(show) and isinstance(wrong, int):  # the command line itself is wrong
            show()
            sys.exit(wrong)
        words = printable_lines(f"{type(error).__name__}: {error}")
        print(
            f"internal error: {words}\n"
            f"This is a mistake of ours. Please report it with {keep_traceback(error)}",
            file=sys.stderr,
        )
        sys.exit(RefdgsError.exit_code)
    if code == Cancelled.exit_code:  # as newer versions of typer say it, too
        _end(Cancelled("stopped. What is finished is kept; run again to go on"))
    sys.exit(code if isinstance(code, int) else 0)


def _end(error: RefdgsError) -> NoReturn:
    """Say what went wrong and end with its exit code."""
    if "--json" in sys.argv:
        kind, code = type(error).__name__, error.exit_code
        failure = {"status": "failed", "kind": kind, "exit_code": code, "message": str(error)}
        print(write_json_text(failure, indent=2))
    prefix = "" if isinstance(error, Cancelled) else "error: "
    print(printable_lines(f"{prefix}{error}"), file=sys.stderr)
    sys.exit(error.exit_code)
