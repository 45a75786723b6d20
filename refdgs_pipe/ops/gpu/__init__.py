"""The kernels of GPUs behind autograd. Tests run them on an emulated grid too."""
