// Every operation of cuda/ for Python, on one kind of queue and in one type.
#pragma once
#include "bind_elementwise.h"
#include "bind_fused.h"

namespace refdgs::cuda {

template <class S, class Queue> void bind_grid(nanobind::module_& m, const std::string& type) {
  bind_adam<S, Queue>(m, type);
  bind_elementwise<S, Queue>(m, type);
  bind_raster<S, Queue>(m, type);
  bind_image_loss<S, Queue>(m, type);
  bind_mlp<S, Queue>(m, type);
  bind_shade<S, Queue>(m, type);
  bind_photo<S, Queue>(m, type);
  bind_sph_mip<S, Queue>(m, type);
}

}  // namespace refdgs::cuda
