// The rasteriser of cuda/raster.h for Python; addresses as in bind.cpp, the first argument is the stream's.
#pragma once
#include <nanobind/nanobind.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/vector.h>

#include <string>

#include "../arguments.h"
#include "raster.h"

namespace refdgs::cuda {

// shape: surfels, channels, width, height, extra, normals, entries.
struct RasterCall {
  Address stream;
  std::vector<int64_t> shape;
  std::vector<Address> in;
  std::vector<double> camera;
  Address lens, by_surfel, by_entry;
};

template <class S> Drawing<S> drawing(const RasterCall& c, RasterSizes* sizes = nullptr) {
  const auto& n = c.shape;
  Drawing<S> d = lay_out<S>(surfels<S>(c.in, n[0], int(n[1])), pinhole<S>(c.camera, int(n[2]), int(n[3])),
                            Extra(n[4]), n[5] != 0, n[6], at<void>(c.by_surfel), at<void>(c.by_entry), sizes);
  d.lens = at<const S>(c.lens);
  return d;
}

template <class S, class Queue> void bind_raster(nanobind::module_& m, const std::string& type) {
  namespace nb = nanobind;
  using Shape = const std::vector<int64_t>&;
  using Addresses = const std::vector<Address>&;
  using Numbers = const std::vector<double>&;
  using Images = const std::vector<std::pair<Address, std::vector<int64_t>>>&;
  // Bytes by surfel and by entry, which are kept, and scratch of project and of draw; scalars of a slot.
  m.def(("raster_sizes_" + type).c_str(), [](Address stream, Shape shape) {
    const Queue q{at<void>(stream)};
    RasterSizes sizes{};
    const auto d = drawing<S>({stream, shape, std::vector<Address>(5), std::vector<double>(17), 0, 0, 0}, &sizes);
    sizes.scan = int64_t(q.scan_bytes(shape[0] + 1 + d.patches()));
    sizes.sort = sort_scratch(shape[6]);
    return std::vector<int64_t>{sizes.by_surfel, sizes.by_entry, sizes.scan, sizes.sort, sizes.slot};
  });
  // The first shape[0] + 1 numbers of by_surfel become the sums of entries. lens: see lens.h, or 0.
  m.def(("raster_project_" + type).c_str(), [](Address stream, Shape shape, Addresses in, Numbers camera, Address lens,
                                               Address by_surfel, Address radii, Address scratch, int64_t bytes) {
    nb::gil_scoped_release release;
    project(Queue{at<void>(stream)}, drawing<S>({stream, shape, in, camera, lens, by_surfel, 0}), at<S>(radii),
            at<void>(scratch), bytes);
  });
  // plan: where the number of entries goes and what says that they do not fit; zeros where shape has that number.
  m.def(("raster_draw_" + type).c_str(), [](Address stream, Shape shape, Addresses in, Numbers camera, Address lens,
                                            Address by_surfel, Address by_entry, Address scratch, Address maps,
                                            Address moments, Addresses plan) {
    nb::gil_scoped_release release;
    Drawing<S> d = drawing<S>({stream, shape, in, camera, lens, by_surfel, by_entry});
    d.maps = at<S>(maps), d.moments = at<S>(moments);
    d.needed = at<int64_t>(plan[0]), d.misfit = at<float>(plan[1]);
    bin_and_draw(Queue{at<void>(stream)}, d, at<void>(scratch));
  });
  // v_maps: of every kind, kShares times; working: slots, activity, sums, pose parts (or 0); out: the seven of
  // SurfelGrads, the second of whose screen's gradients is 0 unless absolute.
  m.def(("raster_backward_" + type).c_str(), [](Address stream, Shape shape, Addresses in, Numbers camera, Address lens,
                                                Address by_surfel, Address by_entry, Address maps, Address moments,
                                                Images v_maps, Addresses working, Addresses out, bool absolute) {
    nb::gil_scoped_release release;
    Drawing<S> d = drawing<S>({stream, shape, in, camera, lens, by_surfel, by_entry});
    d.maps = at<S>(maps), d.moments = at<S>(moments);
    DrawingGrads<S> g{};
    for (size_t k = 0; k < v_maps.size(); ++k) g.maps[k % kPlaneKinds][k / kPlaneKinds] = image<S>(v_maps[k]);
    g.absolute = absolute;
    g.slots = at<S>(working[0]), g.activity = at<uint8_t>(working[1]);
    g.sums = at<S>(working[2]), g.pose_parts = at<S>(working[3]);
    g.out = {at<S>(out[0]), at<S>(out[1]), at<S>(out[2]), at<S>(out[3]),
             at<S>(out[4]), at<S>(out[5]), at<S>(out[6])};
    draw_bwd(Queue{at<void>(stream)}, d, g);
  });
}

}  // namespace refdgs::cuda
