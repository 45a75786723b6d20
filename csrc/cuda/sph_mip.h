// Sph-Mip lookups on the grid. `bits`: the map's gradient as whole numbers, see sph_mip_kernels.h.
#pragma once
#include "../math/vec.h"
#include "../ops/sph_mip.h"
#include "queue.h"

namespace refdgs::cuda {

template <class S> struct SphMipWork {
  int64_t* bits;     // [texels of all levels][4], null if the map's gradient is not wanted
  uint32_t* scale;   // [1] bits of the greatest |v_out|, as float
};

// A query of which only the first *limit directions are looked at; null: all.
template <class S> struct LimitedQuery : SphMipQuery<S> {
  const int64_t* limit;
  REFDGS_HD int64_t last() const { return limit && *limit < this->count ? *limit : this->count; }
};

// Fills the map's coarser levels; out: [count][4].
template <class S, class Queue>
void sph_mip(const Queue& q, const LimitedQuery<S>& query, const MipMap<S>& mips, S* out);
template <class S, class Queue>
void sph_mip_bwd(const Queue& q, const LimitedQuery<S>& query, const S* v_out, const SphMipGrads<S>& grads,
                 const SphMipWork<S>& work);

}  // namespace refdgs::cuda
