"""The engine: stages, keys, cache, lock, events."""
