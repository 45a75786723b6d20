"""The real command line over the small stages of `fake_stages`: python fake_cli.py run LETTERS"""

import os

from fake_stages import BENCH_STAGES, STAGES, Letters

from refdgs_pipe.cli import app
from refdgs_pipe.cli.batch import parts
from refdgs_pipe.pipeline import catalog

if __name__ == "__main__":
    stages = BENCH_STAGES if "FAKE_BENCH" in os.environ else STAGES
    catalog.load_stages = lambda names=(): list(stages)
    catalog.source_type = lambda stages: Letters
    parts.ENDS.update(prepare="read", train="train" if "FAKE_BENCH" in os.environ else "shout")
    app.main()
