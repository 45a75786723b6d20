// The constants of alpha blending, shared by every device and by ops/definition/rasterize.py.
#pragma once

namespace refdgs {

constexpr double kMinAlpha = 1.0 / 255.0;
constexpr double kMaxAlpha = 0.99;
constexpr double kMinTransmittance = 1e-4;
// Beyond this squared radius the ray passes the disc by; only the low-pass filter draws it and its
// depth is the centre's. It exceeds the largest cutoff 2 ln(255).
constexpr double kHitRadius2 = 12.0;
// A disc seen edge-on has no usable inverse; its determinant is kept away from zero by this share.
constexpr double kMinDeterminant = 1e-7;

// The screen-space low-pass filter that a disc is not drawn smaller than: a squared radius of kLowPass d^2 at d
// pixels from the centre, a Gaussian of 1 / sqrt(kLowPass) = 0.35 pixels. With the 2 of 2DGS edges are blurred.
constexpr double kLowPass = 8.0;

}  // namespace refdgs
