"""What `run` says once, before training begins: what `check` would have said of the capture."""

from refdgs_pipe.artifacts.placement import Placement
from refdgs_pipe.artifacts.sparse_model import SparseModel
from refdgs_pipe.artifacts.views import Views
from refdgs_pipe.checking.findings import light
from refdgs_pipe.sfm.around import around


def early_lines(views: Views, placement: Placement, model: SparseModel) -> list[str]:
    """Short lines on a capture that is about to be trained on."""
    total = len(model.cameras) + len(model.lost)
    count = f"{len(model.cameras)} of {total} photos have a trusted place"
    if placement.known:
        count = f"the places of {total} photos came with them"
    whole = around(model)
    lines = [count]
    if whole is not None:
        low, high = whole.heights
        lines[0] += (
            f"; the widest stretch round the object without one is {whole.gap_deg:.0f} degrees, "
            f"heights are {low:.0f} to {high:.0f} degrees"
        )
    lines += placement.notes
    lines += [finding.text for finding in light(views) if finding.state != "ok"]
    return lines
