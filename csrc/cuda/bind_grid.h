// Every operation of cuda/ for Python, on one kind of queue and in one type.
#pragma once
#include "bind_raster.h"

namespace refdgs::cuda {

template <class S, class Queue> void bind_grid(nanobind::module_& m, const std::string& type) {
  bind_raster<S, Queue>(m, type);
}

}  // namespace refdgs::cuda
