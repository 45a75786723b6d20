"""The definition of every operation in plain torch: readable, any precision, slow.

The kernels of the CPU and of GPUs are proved against these (tests/ops). Arguments that are of other
backends only (threads, room for lists) are ignored.
"""
