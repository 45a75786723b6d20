"""The one error of the add-on."""


class AddonError(Exception):
    """What went wrong, in words for the panel: what, what was expected, what to do next."""
