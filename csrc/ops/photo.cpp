#include "photo.h"

#include <algorithm>
#include <vector>

#include "dispatch.h"
#include "parallel.h"

namespace refdgs {

namespace {

const PhotoKernels<float>& photo_kernels(float) { return kernels().photo; }
const PhotoKernels<double>& photo_kernels(double) { return photo_kernels_double(); }

// body(band, first row, one past the last)
template <class F> void over_bands(int height, int threads, F&& body) {
  parallel_for((height + kPhotoBand - 1) / kPhotoBand, threads, [&](int64_t band) {
    body(band, band * kPhotoBand, std::min<int64_t>(height, (band + 1) * kPhotoBand));
  });
}

}  // namespace

template <class S> void composited(const Photo& photo, const S* backdrop, int threads, S* out) {
  const int64_t width = photo.width;
  over_bands(photo.height, threads, [&](int64_t, int64_t first, int64_t last) {
    photo_kernels(S(0)).composited(photo, backdrop, first * width, last * width, out);
  });
}

template <class S> double mask_entropy(const MaskEntropy<S>& in, int threads) {
  std::vector<double> parts(size_t((in.height + kPhotoBand - 1) / kPhotoBand));
  over_bands(in.height, threads, [&](int64_t band, int64_t first, int64_t last) {
    parts[size_t(band)] = photo_kernels(S(0)).mask_entropy(in, first, last);
  });
  double total = 0;
  for (const double part : parts) total += part;
  return total;
}

template void composited<float>(const Photo&, const float*, int, float*);
template void composited<double>(const Photo&, const double*, int, double*);
template double mask_entropy<float>(const MaskEntropy<float>&, int);
template double mask_entropy<double>(const MaskEntropy<double>&, int);

}  // namespace refdgs
