// The deferred shading of one pixel: pixel.inl for scalars.
#pragma once
#include "vec.h"

namespace refdgs {

template <class S> using Value = S;
template <class S> REFDGS_HD S reciprocal(S x) { return 1 / x; }
template <class S> REFDGS_HD S sqrt_of(S x) { return std::sqrt(x); }
template <class S> REFDGS_HD S abs_of(S x) { return std::fabs(x); }
template <class S> REFDGS_HD S power_of(S x, S exponent) { return std::pow(x, exponent); }
template <class S> REFDGS_HD S min_of(S a, S b) { return a < b ? a : b; }
template <class S> REFDGS_HD S max_of(S a, S b) { return a > b ? a : b; }
template <class S> REFDGS_HD bool less(S a, S b) { return a < b; }
template <class S> REFDGS_HD bool at_most(S a, S b) { return a <= b; }
template <class S> REFDGS_HD S select(bool first, S a, S b) { return first ? a : b; }
template <class S> REFDGS_HD S keep(bool kept, S a) { return kept ? a : S(0); }

#include "pixel.inl"

}  // namespace refdgs
