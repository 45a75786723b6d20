// The deferred shading around the shader's network and its way back, at one pixel or at a vector of them. Included
// in a namespace that has Value<S>, a scalar S or a vector of such, and for it reciprocal, sqrt_of, abs_of, min_of,
// max_of, less, at_most, select, keep and power_of.

template <class S> using V3 = Vec3<Value<S>>;
template <class S> REFDGS_HD Value<S> filled(S x) { return Value<S>{} + x; }

template <class S> REFDGS_HD V3<S> rotate(const Mat3<S>& A, const V3<S>& v) {
  return {A.m[0] * v.x + A.m[1] * v.y + A.m[2] * v.z, A.m[3] * v.x + A.m[4] * v.y + A.m[5] * v.z,
          A.m[6] * v.x + A.m[7] * v.y + A.m[8] * v.z};
}
template <class S> REFDGS_HD V3<S> rotate_back(const Mat3<S>& A, const V3<S>& v) {
  return {A.m[0] * v.x + A.m[3] * v.y + A.m[6] * v.z, A.m[1] * v.x + A.m[4] * v.y + A.m[7] * v.z,
          A.m[2] * v.x + A.m[5] * v.y + A.m[8] * v.z};
}

// v / sqrt(|v|^2 + eps) and its backward pass.
template <class S> struct UnitVector {
  V3<S> v, unit;
  Value<S> scale;
  REFDGS_HD UnitVector(const V3<S>& a, S eps) : v(a), scale(reciprocal(sqrt_of(dot(a, a) + eps))) { unit = scale * a; }
  REFDGS_HD V3<S> vjp(const V3<S>& g) const { return scale * g - (scale * scale * scale * dot(v, g)) * v; }
};

// The mirror: the ray (unit, world), the surface's normal, where the ray goes.
template <class S> struct Mirror {
  V3<S> ray;
  UnitVector<S> normal;
  Value<S> towards;
  UnitVector<S> out;

  REFDGS_HD Mirror(const V3<S>& unit_ray, const V3<S>& splatted)
      : ray(unit_ray), normal(splatted, S(1e-16)), towards(-dot(normal.unit, ray)),
        out(ray + (2 * towards) * normal.unit, S(1e-16)) {}

  REFDGS_HD Value<S> cosine() const { return min_of(max_of(towards, Value<S>{}), filled(S(1))); }
  // From the gradients by the mirrored ray and the cosine to the splatted normal's.
  REFDGS_HD V3<S> vjp(const V3<S>& v_reflected, Value<S> v_cosine) const {
    const V3<S> v_out = out.vjp(v_reflected);
    const auto inside = at_most(Value<S>{}, towards) & at_most(towards, filled(S(1)));
    const Value<S> v_towards = 2 * dot(normal.unit, v_out) + keep(inside, v_cosine);
    return normal.vjp((2 * towards) * v_out - v_towards * ray);
  }
};

// A linear value clipped to what sRGB has, its sRGB colour, and the way back: a clipped highlight is never pushed up.
template <class S> struct Shown {
  Value<S> linear, clipped, color;

  REFDGS_HD explicit Shown(Value<S> value)
      : linear(value), clipped(min_of(filled(S(1)), max_of(filled(S(1e-6)), value))) {  // in this order a NaN stays one
    const Value<S> curve = S(1.055) * power_of(clipped, S(1 / 2.4)) - S(0.055);
    color = select(less(filled(S(0.0031308)), clipped), curve, S(12.92) * clipped);
  }
  REFDGS_HD Value<S> vjp(Value<S> v_color) const {
    const Value<S> curve = (color + S(0.055)) * reciprocal(S(2.4) * clipped);
    const Value<S> g = v_color * select(at_most(clipped, filled(S(0.0031308))), filled(S(12.92)), curve);
    const auto pushed_up = less(filled(S(1)), linear) & less(g, Value<S>{});
    return select(less(linear, filled(S(1e-6))) | pushed_up, Value<S>{}, g);
  }
};

// The depth's greater second difference at a pixel, from its neighbours' depths.
template <class S>
REFDGS_HD Value<S> bend_of(Value<S> above, Value<S> below, Value<S> left, Value<S> right, Value<S> here) {
  return max_of(abs_of(above + below - 2 * here), abs_of(left + right - 2 * here));
}

// n . n_depth at a pixel from the steps between its neighbours' points; gradients of g times it.
template <class S> struct NormalPair {
  Value<S> agreement;
  V3<S> v_down, v_right, v_normal;

  REFDGS_HD NormalPair(const V3<S>& down, const V3<S>& right, const V3<S>& splatted, const Mat3<S>& world_from_cam,
                       Value<S> g) {
    const UnitVector<S> depth_normal(cross(down, right), S(1e-24)), normal(splatted, S(1e-16));
    const V3<S> seen = rotate_back(world_from_cam, normal.unit);
    agreement = dot(seen, depth_normal.unit);
    const V3<S> v_cross = depth_normal.vjp(g * seen);
    v_down = cross(right, v_cross);
    v_right = cross(v_cross, down);
    v_normal = normal.vjp(g * rotate(world_from_cam, depth_normal.unit));
  }
};
