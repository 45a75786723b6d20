"""Waiting threads sleep soon, as under the command line: the suite stays quick under load."""

import os

os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("GOMP_SPINCOUNT", "20000")
