// A camera whose numbers lie on the device, so that a captured step can be given another one: the rows of
// cam_from_world (12), fx, fy, cx, cy; null where the kernel's own arguments have them. Its size and its nearest depth
// stay arguments.
#pragma once
#include "../math/surfel.h"
#include "../ops/shade.h"

namespace refdgs::cuda {

template <class S> REFDGS_HD Pinhole<S> seen_through(const S* lens, Pinhole<S> cam) {
  if (!lens) return cam;
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column) cam.R.m[3 * row + column] = lens[4 * row + column];
  cam.t = {lens[3], lens[7], lens[11]};
  cam.fx = lens[12], cam.fy = lens[13], cam.cx = lens[14], cam.cy = lens[15];
  return cam;
}

template <class S> REFDGS_HD View<S> seen_through(const S* lens, View<S> view) {
  if (!lens) return view;
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 3; ++column) view.world_from_cam.m[3 * row + column] = lens[4 * column + row];
  view.fx = lens[12], view.fy = lens[13], view.cx = lens[14], view.cy = lens[15];
  return view;
}

}  // namespace refdgs::cuda
