"""The command line as `python -m refdgs_pipe`."""

from refdgs_pipe.cli.app import main

if __name__ == "__main__":
    main()
