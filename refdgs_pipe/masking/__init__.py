"""The object's masks from the photos themselves: no network, no strokes."""
