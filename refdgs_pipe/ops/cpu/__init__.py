"""The kernels of the CPU behind autograd. Results do not depend on the number of threads."""
