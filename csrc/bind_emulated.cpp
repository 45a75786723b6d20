// The module _refdgs_emulated: the CUDA kernels on the emulated grid, for tests.
#include "cuda/bind_grid.h"
#include "cuda/emulated_laws.h"

NB_MODULE(_refdgs_emulated, m) {
  refdgs::cuda::bind_grid<float, refdgs::cuda::EmulatedQueue>(m, "float");
  refdgs::cuda::bind_grid<double, refdgs::cuda::EmulatedQueue>(m, "double");
  refdgs::cuda::bind_laws(m);
}
