"""The command line, as `refdgs-pipe` and as `python -m refdgs_pipe`."""

import sys


def main() -> None:
    """Load the command line and run it. Ctrl-C while it loads ends as it does later."""
    try:
        from refdgs_pipe.cli.app import main as command_line
    except KeyboardInterrupt:
        print("stopped before anything was done", file=sys.stderr)
        sys.exit(130)
    command_line()


if __name__ == "__main__":
    main()
