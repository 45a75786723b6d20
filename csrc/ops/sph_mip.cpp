#include "sph_mip.h"

#include <algorithm>
#include <vector>

#include "dispatch.h"
#include "parallel.h"

namespace refdgs {

namespace {

constexpr int64_t kChunk = 2048;       // directions of one task
constexpr int64_t kSmallLevel = 65536;  // texels below which a level is not worth waiting for other threads

SphMipKernels<float> lookup_kernels(float) { return kernels().sph_mip; }
SphMipKernels<double> lookup_kernels(double) { return sph_mip_kernels_double(); }

int threads_for(int64_t texels, int threads) { return texels < kSmallLevel ? 1 : threads; }

// Level l from level l - 1.
template <class S> void average(const S* fine, int height, int width, int threads, S* coarse) {
  parallel_for(height, threads_for(int64_t(height) * width, threads), [&](int64_t row) {
    const S *a = fine + row * 4 * width * kMipChannels, *b = a + 2 * width * kMipChannels;
    S* out = coarse + row * width * kMipChannels;
    for (int column = 0; column < width; ++column, a += 2 * kMipChannels, b += 2 * kMipChannels)
      for (int c = 0; c < kMipChannels; ++c)
        *out++ = S(0.25) * ((a[c] + a[c + kMipChannels]) + (b[c] + b[c + kMipChannels]));
  });
}

// The adjoint of `average`: adds to level l - 1, or starts it.
template <class S>
void spread(const S* coarse, int height, int width, bool start, int threads, S* fine) {
  parallel_for(2 * height, threads_for(int64_t(height) * width, threads), [&](int64_t row) {
    const S* in = coarse + row / 2 * width * kMipChannels;
    S* out = fine + row * 2 * width * kMipChannels;
    for (int column = 0; column < width; ++column, in += kMipChannels, out += 2 * kMipChannels)
      for (int c = 0; c < 2 * kMipChannels; ++c) {
        const S g = S(0.25) * in[c % kMipChannels];
        out[c] = start ? g : out[c] + g;
      }
  });
}

// Shares of the rows of some levels with about as many directions each. Which share owns a row changes no
// result, so a sample of the directions is enough.
template <class S>
std::vector<MipRows> split_rows(const SphMipQuery<S>& q, int first_level, int last_level, int shares) {
  const int top = 2 * (q.map.height >> first_level);
  const int total = top - 2 * (q.map.height >> last_level);
  std::vector<int64_t> work(size_t(total), 1);
  for (int64_t i = 0; shares > 1 && i < q.count; i += 16) {
    const int fine = int(q.coordinates[2 * q.count + i]);
    for (int level = fine; level < std::min(fine + 2, q.map.levels); ++level) {
      if (level < first_level || level >= last_level) continue;
      const int rows = q.map.height >> level;
      const int row = std::clamp(int(q.coordinates[q.count + i] * S(rows)), 0, rows - 1);
      work[size_t(top - 2 * rows + row)] += 64;
    }
  }
  int64_t all = 0, seen = 0;
  for (const int64_t w : work) all += w;
  std::vector<MipRows> out;
  for (int row = 0, begin = 0; row < total; ++row) {
    seen += work[size_t(row)];
    if (seen * shares < all * int64_t(out.size() + 1) && row + 1 < total) continue;
    out.push_back({first_level, last_level, begin, row + 1});
    begin = row + 1;
  }
  return out;
}

}  // namespace

template <class S> void sph_mip(SphMipQuery<S> query, const MipMap<S>& mips, int threads, S* out) {
  for (int level = 1; level < mips.levels; ++level)
    average<S>(mips.level[level - 1], mips.height >> level, mips.width >> level, threads, mips.level[level]);
  const auto lookup = lookup_kernels(S(0)).lookup;
  parallel_for((query.count + kChunk - 1) / kChunk, threads, [&](int64_t chunk) {
    lookup(query, chunk * kChunk, std::min(query.count, (chunk + 1) * kChunk), out);
  });
}

template <class S>
void sph_mip_bwd(const SphMipQuery<S>& query, const S* v_out, const SphMipGrads<S>& grads, int threads) {
  const SphMipKernels<S> work = lookup_kernels(S(0));
  parallel_for((query.count + kChunk - 1) / kChunk, threads, [&](int64_t chunk) {
    work.lookup_bwd(query, chunk * kChunk, std::min(query.count, (chunk + 1) * kChunk), v_out, grads);
  });
  const MipMap<S>& map = grads.map;
  if (!map.level[0]) return;
  const auto scatter = [&](int first_level, int last_level) {
    const auto shares = split_rows(query, first_level, last_level, std::max(1, threads));
    parallel_for(int64_t(shares.size()), threads,
                 [&](int64_t share) { work.scatter(query, v_out, map, shares[size_t(share)]); });
  };
  // Coarse levels first: the finest one starts from what they pass down and is written once.
  const auto texels = [&](int level) { return int64_t(map.height >> level) * (map.width >> level); };
  for (int level = 1; level < map.levels; ++level)
    std::fill(map.level[level], map.level[level] + texels(level) * kMipChannels, S(0));
  if (map.levels > 1) scatter(1, map.levels);
  for (int level = map.levels - 1; level > 0; --level)
    spread<S>(map.level[level], map.height >> level, map.width >> level, level == 1, threads, map.level[level - 1]);
  if (map.levels == 1) std::fill(map.level[0], map.level[0] + texels(0) * kMipChannels, S(0));
  scatter(0, 1);
}

template void sph_mip<float>(SphMipQuery<float>, const MipMap<float>&, int, float*);
template void sph_mip<double>(SphMipQuery<double>, const MipMap<double>&, int, double*);
template void sph_mip_bwd<float>(const SphMipQuery<float>&, const float*, const SphMipGrads<float>&, int);
template void sph_mip_bwd<double>(const SphMipQuery<double>&, const double*, const SphMipGrads<double>&, int);

}  // namespace refdgs
