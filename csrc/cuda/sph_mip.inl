// The steps of sph_mip.h on any queue; included by one file for each.
#include "sph_mip_kernels.h"

namespace refdgs::cuda {

template <class S, class Queue>
void sph_mip(const Queue& q, const LimitedQuery<S>& query, const MipMap<S>& mips, S* out) {
  constexpr int side = AverageLevels<S>::kSide, steps = 5;  // 32 texels become 1 in 5
  for (int first = 0; first + 1 < mips.levels; first += steps) {
    const int last = first + steps < mips.levels ? first + steps : mips.levels - 1;
    const int64_t across = blocks_for(mips.width >> first, side), down = blocks_for(mips.height >> first, side);
    q.run(across * down, AverageLevels<S>{mips, first, last});
  }
  q.run(blocks_for(query.count, LookUp<S>::kThreads), LookUp<S>{query, out});
}

template <class S, class Queue>
void sph_mip_bwd(const Queue& q, const LimitedQuery<S>& query, const S* v_out, const SphMipGrads<S>& grads,
                 const SphMipWork<S>& work) {
  const auto& map = query.map;
  if (work.bits) {
    int64_t texels = 0;
    for (int l = 0; l < map.levels; ++l) texels += int64_t(map.height >> l) * (map.width >> l);
    q.zero(work.bits, size_t(texels) * kMipChannels * sizeof(int64_t));
    q.zero(work.scale, sizeof(uint32_t));
    const int64_t numbers = query.count * kMipChannels;
    q.run(blocks_for(numbers, FindScale<S>::kThreads * FindScale<S>::kEach),
          FindScale<S>{v_out, query, work.scale});
  }
  q.run(blocks_for(query.count, LookUpBwd<S>::kThreads), LookUpBwd<S>{query, v_out, grads, work});
  if (work.bits)
    q.run(blocks_for(int64_t(map.height) * map.width * kMipChannels, GatherLevels<S>::kThreads),
          GatherLevels<S>{query, work, grads.map.level[0]});
}

#define REFDGS_SPH_MIP(S, Queue)                                                                            \
  template void sph_mip<S, Queue>(const Queue&, const LimitedQuery<S>&, const MipMap<S>&, S*);               \
  template void sph_mip_bwd<S, Queue>(const Queue&, const LimitedQuery<S>&, const S*, const SphMipGrads<S>&, \
                                      const SphMipWork<S>&);

}  // namespace refdgs::cuda
