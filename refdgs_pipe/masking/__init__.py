"""The object's masks from the photos themselves, or by a network of the user's."""
