// The steps of raster.h on any queue; included by one file for each.
#include <stdexcept>
#include <string>

#include "raster_bin.h"
#include "raster_sums.h"

namespace refdgs::cuda {

namespace {

// Takes blocks of memory aligned to 256 bytes, as torch gives it.
class Carver {
 public:
  explicit Carver(void* at) : at_(static_cast<char*>(at)) {}
  template <class T> T* take(int64_t count) {
    char* here = at_ ? at_ + used_ : nullptr;
    used_ += (count * int64_t(sizeof(T)) + 255) / 256 * 256;
    return reinterpret_cast<T*>(here);
  }
  int64_t used() const { return used_; }

 private:
  char* at_;
  int64_t used_ = 0;
};

struct SortMemory {
  uint64_t* keys;
  int32_t* owners;
  int64_t used;
  SortMemory(void* at, int64_t count) {
    Carver memory(at);
    keys = memory.take<uint64_t>(count);
    owners = memory.take<int32_t>(count);
    used = memory.used();
  }
};

}  // namespace

int64_t sort_scratch(int64_t count) { return SortMemory(nullptr, count).used; }

template <class S> Drawing<S> lay_out(const Surfels<S>& surfels, const Pinhole<S>& cam, Extra extra, bool normals,
                                      int64_t count, void* by_surfel, void* by_entry, RasterSizes* sizes) {
  if (count > INT32_MAX || surfels.count > INT32_MAX)
    throw std::runtime_error("surfels cover patches " + std::to_string(count) + " times; at most 2^31 is possible");
  Drawing<S> d{};
  d.surfels = surfels, d.cam = cam, d.extra = extra, d.normals = normals, d.count = count;
  d.padded = Raster<S>::padded(surfels.channels, normals);
  d.stride = sectors(kDrawnHead + d.padded);
  d.tiles_x = (cam.width + kTile - 1) / kTile;
  d.tiles_y = (cam.height + kTile - 1) / kTile;
  Carver a(by_surfel), b(by_entry);
  d.slot_start = a.take<int64_t>(surfels.count + 1 + d.patches());
  d.list_end = d.slot_start + surfels.count + 1;
  d.records = a.take<S>(surfels.count * d.stride);
  d.shapes = a.take<S>(surfels.count * kShape);
  d.boxes = a.take<Box>(surfels.count);
  d.entries = b.take<Entry>(count);
  d.patch_stop = b.take<int32_t>(d.patches());
  if (sizes) sizes->by_surfel = a.used(), sizes->by_entry = b.used(), sizes->slot = d.slot_width();
  return d;
}

template <class S, class Queue>
void project(const Queue& q, const Drawing<S>& d, S* radii, void* scratch, int64_t bytes) {
  const int64_t n = d.surfels.count;
  q.zero(d.slot_start + n, size_t(1 + d.patches()) * sizeof(int64_t));
  q.run(blocks_for(n, Project<S>::kThreads), Project<S>{d, radii});
  q.scan(d.slot_start, n + 1 + d.patches(), scratch, size_t(bytes));
}

template <class S, class Queue> void bin_and_draw(const Queue& q, const Drawing<S>& d, void* scratch) {
  const SortMemory m(scratch, d.count);
  q.run(blocks_for(d.surfels.count + 1, EmitEntries<S>::kThreads), EmitEntries<S>{d, m.keys, m.owners});
  if (d.count) q.run(d.patches() / SortLists<S>::kWarps, SortLists<S>{d, m.keys, m.owners});
  switch (d.padded) {
    case 4: return draw_tiles<S, Queue, 4>(q, d);
    case 8: return draw_tiles<S, Queue, 8>(q, d);
    case 12: return draw_tiles<S, Queue, 12>(q, d);
    case 16: return draw_tiles<S, Queue, 16>(q, d);
    default: return draw_tiles<S, Queue, 20>(q, d);
  }
}

template <class S, class Queue> void draw_bwd(const Queue& q, const Drawing<S>& d, const DrawingGrads<S>& g) {
  if (d.count) switch (d.padded) {
    case 4: draw_tiles_bwd<S, Queue, 4>(q, d, g); break;
    case 8: draw_tiles_bwd<S, Queue, 8>(q, d, g); break;
    case 12: draw_tiles_bwd<S, Queue, 12>(q, d, g); break;
    case 16: draw_tiles_bwd<S, Queue, 16>(q, d, g); break;
    default: draw_tiles_bwd<S, Queue, 20>(q, d, g);
  }
  const int64_t n = d.surfels.count, blocks = blocks_for(n, kVjpThreads);
  q.run(blocks_for(n, SumSlots<S>::kThreads / kWarp), SumSlots<S>{d, g});
  q.run(blocks, SurfelVjp<S>{d, g});
  if (g.pose_parts) q.run(1, SumRows<S>{g.pose_parts, blocks, 12, g.out.cam_from_world});
}

#define REFDGS_RASTER(S, Queue)                                                              \
  template Drawing<S> lay_out<S>(const Surfels<S>&, const Pinhole<S>&, Extra, bool, int64_t, \
                                 void*, void*, RasterSizes*);                                \
  template void project<S, Queue>(const Queue&, const Drawing<S>&, S*, void*, int64_t);      \
  template void bin_and_draw<S, Queue>(const Queue&, const Drawing<S>&, void*);              \
  template void draw_bwd<S, Queue>(const Queue&, const Drawing<S>&, const DrawingGrads<S>&);

}  // namespace refdgs::cuda
