// The launches of raster_tiles.h for one number of channels.
#include "raster_tiles.h"

namespace refdgs::cuda {

template <class S, class Queue, int C> void draw_tiles(const Queue& q, const Drawing<S>& d) {
  switch (d.extra) {
    case Extra::none: return q.run(d.patches() / DrawTiles<S, C, 0>::kWarps, DrawTiles<S, C, 0>{d});
    case Extra::depth: return q.run(d.patches() / DrawTiles<S, C, 1>::kWarps, DrawTiles<S, C, 1>{d});
    default: return q.run(d.patches() / DrawTiles<S, C, 2>::kWarps, DrawTiles<S, C, 2>{d});
  }
}

template <class S, class Queue, int C>
void draw_tiles_bwd(const Queue& q, const Drawing<S>& d, const DrawingGrads<S>& g) {
  switch (d.extra) {
    case Extra::none: return q.run(d.patches() / DrawTilesBwd<S, C, 0>::kWarps, DrawTilesBwd<S, C, 0>{d, g});
    case Extra::depth: return q.run(d.patches() / DrawTilesBwd<S, C, 1>::kWarps, DrawTilesBwd<S, C, 1>{d, g});
    default: return q.run(d.patches() / DrawTilesBwd<S, C, 2>::kWarps, DrawTilesBwd<S, C, 2>{d, g});
  }
}

#define REFDGS_TILES(S, Queue, C)                                          \
  template void draw_tiles<S, Queue, C>(const Queue&, const Drawing<S>&);  \
  template void draw_tiles_bwd<S, Queue, C>(const Queue&, const Drawing<S>&, const DrawingGrads<S>&);

}  // namespace refdgs::cuda
