"""What a run says of the photos before training begins."""

from typing import Any

from refdgs_pipe.cli.workspace import Workspace
from refdgs_pipe.errors import RefdgsError


def early_lines(workspace: Workspace) -> list[str]:
    """What to say of the capture before training begins; nothing where that cannot be read."""
    from refdgs_pipe.artifacts.placement import Placement
    from refdgs_pipe.artifacts.sparse_model import SparseModel
    from refdgs_pipe.artifacts.views import Views
    from refdgs_pipe.checking import early

    store, found = workspace.pipeline.store, dict[type, Any]()
    kinds: tuple[type[Any], ...] = (Views, Placement, SparseModel)
    try:
        for stage in workspace.pipeline.stages:
            manifest = store.current(stage.name)
            if stage.output in kinds and manifest is not None:
                found[stage.output] = stage.output.load(store.folder(manifest.origin))
        return early.early_lines(*(found[kind] for kind in kinds))
    except (RefdgsError, OSError, KeyError, ValueError):
        return []
