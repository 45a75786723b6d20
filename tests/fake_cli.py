"""The real command line over the small stages of `fake_stages`: python fake_cli.py run LETTERS"""

from fake_stages import STAGES, Letters

from refdgs_pipe.cli import app
from refdgs_pipe.pipeline import catalog

if __name__ == "__main__":
    catalog.load_stages = lambda names=(): list(STAGES)
    catalog.source_type = lambda stages: Letters
    app.main()
