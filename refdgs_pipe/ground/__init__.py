"""The plane that an object stands on, as the photos show it."""
