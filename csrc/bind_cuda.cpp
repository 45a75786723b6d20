// The submodule _refdgs_native.cuda.
#include "cuda/bind_grid.h"

void bind_cuda(nanobind::module_& m) {
  nanobind::module_ cuda = m.def_submodule("cuda");
  refdgs::cuda::bind_grid<float, refdgs::cuda::DeviceQueue>(cuda, "float");
}
