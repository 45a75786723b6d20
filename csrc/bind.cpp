// The module _refdgs_native. Arrays come as addresses of contiguous tensors that Python allocated and
// checked (refdgs_pipe/ops is the only caller); they must stay alive during the call.
#include <nanobind/nanobind.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include "arguments.h"
#include "ops/dispatch.h"
#if defined(REFDGS_WITH_CUDA)
#include "cuda/device.h"
#endif

#if defined(__GLIBC__)
#include <malloc.h>
#endif

namespace nb = nanobind;
void bind_fused(nb::module_& m);
#if defined(REFDGS_WITH_CUDA)
void bind_cuda(nb::module_& m);
#endif
using namespace refdgs;

namespace {

template <class S> void bind_raster(nb::module_& m, const char* name) {
  nb::class_<Raster<S>>(m, name)
      .def(nb::init<>())
      .def("forward",
           [](Raster<S>& self, const std::vector<Address>& in, int64_t count, int channels,
              const std::vector<double>& camera, int width, int height, int extra, bool normals, int threads,
              bool absolute, Address needed, Address maps, Address radii) {
             nb::gil_scoped_release release;
             self.forward(surfels<S>(in, count, channels), pinhole<S>(camera, width, height),
                          {Extra(extra), normals, threads, absolute, at<const uint8_t>(needed)}, at<S>(maps), at<S>(radii));
           })
      .def("backward",
           [](Raster<S>& self, const std::vector<Address>& in, int64_t count, int channels, Address maps,
              const std::vector<Address>& v_maps, const std::vector<Address>& out) {
             nb::gil_scoped_release release;
             std::vector<const S*> v_planes;
             for (const Address plane : v_maps) v_planes.push_back(at<S>(plane));
             self.backward(surfels<S>(in, count, channels), at<S>(maps), v_planes.data(),
                           {at<S>(out[0]), at<S>(out[1]), at<S>(out[2]), at<S>(out[3]), at<S>(out[4]),
                            at<S>(out[5]), at<S>(out[6])});
           })
      .def_prop_ro("entries", &Raster<S>::entries);
}

// Training makes and drops the same megabytes every step; handing them back to the system each time
// costs more in page faults than the arithmetic (measured: 240 -> 144 core-ms a step).
void keep_freed_memory() {
#if defined(__GLIBC__)
  mallopt(M_MMAP_THRESHOLD, 1 << 30);
  mallopt(M_TRIM_THRESHOLD, 2147483647);
  mallopt(M_TOP_PAD, 64 << 20);
#endif
}

}  // namespace

NB_MODULE(_refdgs_native, m) {
  nb::set_leak_warnings(false);  // frames kept for reuse live until the process ends
  m.def("keep_freed_memory", &keep_freed_memory);
  m.def("isa", [] { return std::string(kernels().name); });
#if defined(_OPENMP)
  m.attr("openmp") = true;
#else
  m.attr("openmp") = false;
#endif
  bind_raster<float>(m, "RasterFloat");
  bind_raster<double>(m, "RasterDouble");
  bind_fused(m);
#if defined(REFDGS_WITH_CUDA)
  m.attr("cuda_archs") = REFDGS_ARCHS;
  m.def("cuda_device", &cuda::device_name);
  bind_cuda(m);
#else
  m.attr("cuda_archs") = "";
  m.def("cuda_device", [] { return std::string(); });
#endif
}
