#include "shade.h"

#include <algorithm>
#include <vector>

#include "buffer.h"
#include "dispatch.h"
#include "parallel.h"

namespace refdgs {

namespace {

const ShadeKernels<float>& pixel_kernels(float) { return kernels().shade; }
const ShadeKernels<double>& pixel_kernels(double) { return shade_kernels_double(); }

// body(band, thread) on bands of rows; pixels: ascending.
template <class F>
void over_bands(int width, int height, const int64_t* pixels, int64_t count, int threads, F&& body) {
  const int bands = (height + kShadeBand - 1) / kShadeBand;
  const auto reach = [&](int64_t row) { return std::lower_bound(pixels, pixels + count, row * width) - pixels; };
  parallel_for_dynamic(bands, threads, [&](int64_t band, int thread) {
    const int first = int(band) * kShadeBand, last = std::min(height, first + kShadeBand);
    body(Band{first, last, reach(first), reach(last)}, thread);
  });
}

}  // namespace

template <class S> void shading_inputs(const Covered<S>& at, int threads, const Inputs<S>& out) {
  over_bands(at.view.width, at.view.height, at.pixels, at.count, threads,
             [&](Band band, int) { pixel_kernels(S(0)).inputs(at, band, out); });
}

template <class S>
void shading_inputs_bwd(const Covered<S>& at, const Inputs<const S>& v_out, int threads, const MapGrads<S>& grads) {
  over_bands(at.view.width, at.view.height, at.pixels, at.count, threads,
             [&](Band band, int) { pixel_kernels(S(0)).inputs_bwd(at, band, v_out, grads); });
}

template <class S> void composite(const Composite<S>& in, int threads, S* image) {
  over_bands(in.width, in.height, in.pixels, in.count, threads,
             [&](Band band, int) { pixel_kernels(S(0)).composite(in, band, image); });
}

template <class S>
void composite_bwd(const Composite<S>& in, Image<S> v_image, int threads, S* v_linear, S* v_object_alpha, S* v_alpha) {
  over_bands(in.width, in.height, in.pixels, in.count, threads, [&](Band band, int) {
    pixel_kernels(S(0)).composite_bwd(in, band, v_image, v_linear, v_object_alpha, v_alpha);
  });
}

template <class S> double normal_agreement(const Agreement<S>& in, int threads) {
  const int width = in.view.width, height = in.view.height;
  std::vector<double> rows(size_t(height), 0.0);
  std::vector<Buffer<S>> scratch(size_t(std::max(1, threads)));
  over_bands(width, height, nullptr, 0, threads, [&](Band band, int thread) {
    Buffer<S>& mine = scratch[size_t(thread)];
    if (!mine.data) mine.make(slope_scratch(width));
    pixel_kernels(S(0)).agreement(in, band, mine.data, rows.data() + band.first);
  });
  double total = 0;
  for (double row : rows) total += row;
  return total;
}

template <class S> double normal_smoothness(const Smoothness<S>& in, int threads) {
  std::vector<double> rows(size_t(in.height), 0.0);
  over_bands(in.width, in.height, nullptr, 0, threads,
             [&](Band band, int) { pixel_kernels(S(0)).smoothness(in, band, rows.data() + band.first); });
  double total = 0;
  for (double row : rows) total += row;
  return total;
}

#define REFDGS_SHADE(S)                                                                                      \
  template void shading_inputs<S>(const Covered<S>&, int, const Inputs<S>&);                                 \
  template void shading_inputs_bwd<S>(const Covered<S>&, const Inputs<const S>&, int, const MapGrads<S>&);   \
  template void composite<S>(const Composite<S>&, int, S*);                                                  \
  template void composite_bwd<S>(const Composite<S>&, Image<S>, int, S*, S*, S*);                            \
  template double normal_agreement<S>(const Agreement<S>&, int);                                             \
  template double normal_smoothness<S>(const Smoothness<S>&, int);
REFDGS_SHADE(float)
REFDGS_SHADE(double)

}  // namespace refdgs
