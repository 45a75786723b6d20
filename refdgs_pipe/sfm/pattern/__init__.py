"""Photos placed by what tells the repeats of a regular ground apart."""
