"""The simulator's substep as C++ text for one native Warp function, CPU and CUDA from this one source.

A `Lane` is sixteen (or one) worlds side by side on CPU and one float on CUDA. Semi-implicit Euler
(paper III-A):  v += h (f/m + g);  x += h v.  Forces are scattered from springs and bends to particles.

Placeholders in @ @ are filled by `kernel.py` with the traced laws of the effects in play. Bending stands in
`source_bending.py`, contact, particles and grippers in `source_contact.py`.
"""

PRELUDE = r"""
#if defined(__CUDA_ARCH__) || @SCALAR@
  typedef float Lane;
  const int LANES = 1;
  auto lane_sqrt = [](Lane a) -> Lane { return sqrtf(a); };
  auto lane_select = [](bool c, Lane a, Lane b) -> Lane { return c ? a : b; };
  auto lane_exp = [](Lane a) -> Lane { return expf(a); };
  auto lane_log = [](Lane a) -> Lane { return logf(a); };
  auto lane_round = [](Lane a) -> Lane { return rintf(a); };
  auto lane_sin = [](Lane a) -> Lane { return sinf(a); };
  auto lane_cos = [](Lane a) -> Lane { return cosf(a); };
#else
  typedef float Lane __attribute__((ext_vector_type(@LANES@)));
  const int LANES = @LANES@;
  @VECTOR_FUNCTIONS@
#endif
  auto lane_min = [&](Lane a, Lane b) -> Lane { return lane_select(a < b, a, b); };
  auto lane_max = [&](Lane a, Lane b) -> Lane { return lane_select(a > b, a, b); };
  const Lane zero = Lane(0.0f), one = Lane(1.0f), tiny = Lane(1e-18f);
  // Straight lines between `count` values at 0, 1/(count-1), ..., 1; the place is the same in all lanes.
  auto lane_interpolate = [](const Lane* values, int count, float place) -> Lane {
    const float inside = place < 0.0f ? 0.0f : place > 1.0f ? 1.0f : place;
    const float scaled = inside * (count - 1);
    const int below = scaled < count - 2 ? (int)scaled : count - 2;
    const float rest = scaled - below;
    return values[below] * (1.0f - rest) + values[below + 1] * rest;
  };
  const int D = @STRIDE@;  // floats a particle takes per lane: x y z (and one unused)

  // Model: shared by all worlds.
  const int* springs = (const int*)m.springs.data;              // (S, 2)
  const float* spring_data = (const float*)m.spring_data.data;  // (5, S) 1/l0, l0, stiffness, damping scale, arc
  const int* bends = (const int*)m.bends.data;                  // (B, 3) before, at, after
  const float* bend_data = (const float*)m.bend_data.data;      // (B, 4) scale/lbar, lbar, arc, share of the twist
  const float* particle_data = (const float*)m.particle_data.data;  // (N, 2) friction scale, arc
  const int* fixture_shape = (const int*)m.fixture_shape.data;  // (F,) 0 sphere, 1 capsule, 2 box
  const float* fixture_data = (const float*)m.fixture_data.data;  // (F, 16)
  const int* pairs = (const int*)m.pairs.data;                  // (C, 2) self-collision candidates
  const int* held = (const int*)m.held.data;                    // (H, 2) particle, gripper
  const int N = m.particles, S = m.spring_count, B = m.bend_count, G = m.grippers, H = m.held_count;
  const int F = m.fixture_count, C = m.pair_count, Q = m.parameter_count, T = m.periods;
  const float h = m.substep;
  // Worlds: one block of lanes.
  Lane* X = (Lane*)w.position.data + (size_t)block * N * D;
  Lane* V = (Lane*)w.velocity.data + (size_t)block * N * D;
  Lane* A = (Lane*)w.force.data + (size_t)block * N * D;
  const Lane* mass = (const Lane*)w.mass.data + (size_t)block * N;
  const Lane* inverse_mass = (const Lane*)w.inverse_mass.data + (size_t)block * N;
  const Lane* P = (const Lane*)w.parameters.data + (size_t)block * Q;
  const Lane* spring_mask = m.masked ? (const Lane*)w.spring_mask.data + (size_t)block * S : (const Lane*)0;
  const Lane* held_mask = (const Lane*)w.held_mask.data + (size_t)block * H;
  const Lane* held_offset = (const Lane*)w.held_offset.data + (size_t)block * H * 3;
  Lane* held_lever = (Lane*)w.held_lever.data + (size_t)block * H * 3;
  const Lane* grips = (const Lane*)w.grips.data + (size_t)block * (T + 1) * G * 8;  // (T+1, G, 8) p, q wxyz, closed
  float* out = (float*)w.trajectory_out.data;  // (T, worlds, N, 3)
  const Lane start_time = ((const Lane*)w.time.data)[block];  // [s] of the session, when the rollout began
  const Lane steps = ((const Lane*)w.steps.data)[block];      // periods since; counted, so that calls add up exactly
  const Lane stiffness = P[0], damping = P[1], friction = P[2], bending = P[3];

  // CPU: one thread adds. CUDA: springs of one particle run at the same time.
  auto add = [](Lane* target, Lane value) {
#if defined(__CUDA_ARCH__)
    atomicAdd(target, value);
#else
    *target += value;
#endif
  };
  auto clock = [&](int period, int sub) -> Lane {
    return start_time + ((steps + (float)period) * m.substeps + sub) * h;
  };
  auto record = [&](int period, int k) {  // one coordinate of every lane
    const Lane value = X[D * (k / 3) + k % 3];
    const float* lane = (const float*)&value;
    const size_t worlds = (size_t)m.blocks * LANES;
    for (int l = 0; l < LANES; ++l) out[((size_t)period * worlds + (size_t)block * LANES + l) * 3 * N + k] = lane[l];
  };
"""

VECTOR_FUNCTIONS = r"""
  auto lane_sqrt = [](Lane a) -> Lane { return __builtin_elementwise_sqrt(a); };
  auto lane_select = [](auto c, Lane a, Lane b) -> Lane { return c ? a : b; };
  auto lane_exp = [](Lane a) -> Lane { for (int k = 0; k < LANES; ++k) a[k] = expf(a[k]); return a; };
  auto lane_log = [](Lane a) -> Lane { for (int k = 0; k < LANES; ++k) a[k] = logf(a[k]); return a; };
  auto lane_round = [](Lane a) -> Lane { return __builtin_elementwise_rint(a); };
  auto lane_sin = [](Lane a) -> Lane { for (int k = 0; k < LANES; ++k) a[k] = sinf(a[k]); return a; };
  auto lane_cos = [](Lane a) -> Lane { for (int k = 0; k < LANES; ++k) a[k] = cosf(a[k]); return a; };
"""

# Tension of a spring over its length, from the difference of its ends' positions (d) and velocities (u).
SPRING_LAW = r"""
    const Lane length = lane_sqrt(dx * dx + dy * dy + dz * dz + tiny);
    const Lane inverse = one / length;
    const Lane rate = (ux * dx + uy * dy + uz * dz) * inverse;
    const Lane k = stiffness * spring(2), c = damping * spring(3);
    Lane tension = k * (length * spring(0) - one) + c * rate;
    @SPRING@
    if (spring_mask) tension = tension * mask();
    const Lane g = tension * inverse;
"""

SPRING = r"""
  auto spring_force = [&](int s, Lane time) {
    const int i = springs[2 * s], j = springs[2 * s + 1];
    auto spring = [&](int k) -> float { return spring_data[k * S + s]; };
    auto mask = [&]() -> Lane { return spring_mask[s]; };
    const Lane dx = X[D * j] - X[D * i], dy = X[D * j + 1] - X[D * i + 1], dz = X[D * j + 2] - X[D * i + 2];
    const Lane ux = V[D * j] - V[D * i], uy = V[D * j + 1] - V[D * i + 1], uz = V[D * j + 2] - V[D * i + 2];
    @SPRING_LAW@
    const Lane fx = g * dx, fy = g * dy, fz = g * dz;
    add(A + D * i, fx); add(A + D * i + 1, fy); add(A + D * i + 2, fz);
    add(A + D * j, -fx); add(A + D * j + 1, -fy); add(A + D * j + 2, -fz);
  };
"""

# One world on CPU: eight springs side by side. Particles are four floats apart, so that an end is one load.
SPRING_EIGHT = r"""
  typedef float Four __attribute__((ext_vector_type(4)));
  auto eight_springs = [&](int s, float time_of_all) {
    typedef float Lane __attribute__((ext_vector_type(8)));
    typedef float Loose __attribute__((ext_vector_type(8), aligned(4)));
    const int LANES = 8;
    @VECTOR_FUNCTIONS@
    const Lane zero = Lane(0.0f), one = Lane(1.0f), tiny = Lane(1e-18f), time = Lane(time_of_all);
    auto spring = [&](int k) -> Lane { return *(const Loose*)(spring_data + k * S + s); };
    auto mask = [&]() -> Lane { return *(const Loose*)(spring_mask + s); };
    const int* ends = springs + 2 * s;
    // Rows e and e + 4 side by side: a 4 x 4 transpose of the halves gives x, y and z of eight springs.
    auto row = [&](const float* of, int e) -> Lane {
      const Four low = *(const Four*)(of + 4 * ends[2 * e + 1]) - *(const Four*)(of + 4 * ends[2 * e]);
      const Four high = *(const Four*)(of + 4 * ends[2 * e + 9]) - *(const Four*)(of + 4 * ends[2 * e + 8]);
      return __builtin_shufflevector(low, high, 0, 1, 2, 3, 4, 5, 6, 7);
    };
    auto low_pairs = [](Lane a, Lane b) -> Lane { return __builtin_shufflevector(a, b, 0, 8, 1, 9, 4, 12, 5, 13); };
    auto high_pairs = [](Lane a, Lane b) -> Lane { return __builtin_shufflevector(a, b, 2, 10, 3, 11, 6, 14, 7, 15); };
    auto first = [](Lane a, Lane b) -> Lane { return __builtin_shufflevector(a, b, 0, 1, 8, 9, 4, 5, 12, 13); };
    auto second = [](Lane a, Lane b) -> Lane { return __builtin_shufflevector(a, b, 2, 3, 10, 11, 6, 7, 14, 15); };
    auto transpose = [&](const float* of, Lane& x, Lane& y, Lane& z) {
      const Lane r0 = row(of, 0), r1 = row(of, 1), r2 = row(of, 2), r3 = row(of, 3);
      const Lane a = low_pairs(r0, r1), b = low_pairs(r2, r3), c = high_pairs(r0, r1), d = high_pairs(r2, r3);
      x = first(a, b); y = second(a, b); z = first(c, d);
    };
    Lane dx, dy, dz, ux, uy, uz;
    transpose(X, dx, dy, dz);
    transpose(V, ux, uy, uz);
    @SPRING_LAW@
    const Lane fx = g * dx, fy = g * dy, fz = g * dz;
    const Lane p = low_pairs(fx, fy), q = low_pairs(fz, zero), r = high_pairs(fx, fy), t = high_pairs(fz, zero);
    const Lane rows[4] = {first(p, q), second(p, q), first(r, t), second(r, t)};
    for (int e = 0; e < 8; ++e) {
      const Four f = e < 4 ? rows[e & 3].lo : rows[e & 3].hi;
      *(Four*)(A + 4 * ends[2 * e]) += f;
      *(Four*)(A + 4 * ends[2 * e + 1]) -= f;
    }
  };
"""

ALL_SPRINGS = "for (int s = 0; s < S; ++s) spring_force(s, time);"
ALL_SPRINGS_EIGHT = r"""
      for (int s = 0; s + 8 <= S; s += 8) eight_springs(s, time);
      for (int s = S & ~7; s < S; ++s) spring_force(s, time);
"""

# All periods and substeps of one block of worlds in one call (CPU).
FUSED = r"""
  for (int period = 0; period < T; ++period) {
    for (int sub = 0; sub < m.substeps; ++sub) {
      const Lane time = clock(period, sub);
      const float alpha = sub * m.inverse_substeps;
      @ALL_SPRINGS@
      @ALL_BENDS@
      for (int c = 0; c < C; ++c) pair_impulse(c);
      for (int i = 0; i < N; ++i) integrate(i, period, alpha, time);
      for (int e = 0; e < H; ++e) hold(e, period, sub, time + h);
    }
    for (int k = 0; k < 3 * N; ++k) record(period, k);
  }
"""

# One stage of one substep for one element of one world (CUDA): 0 springs, 1 bends and pairs, 2 particles, 3 held,
# 4 record the period. The period's number is read from the device, so that one recorded period can be replayed.
STAGED = r"""
  const int period = ((const int*)w.clock.data)[0], sub = m.stage_sub;
  const Lane time = clock(period, sub);
  const float alpha = sub * m.inverse_substeps;
  if (m.stage == 0) { if (element < S) spring_force(element, time); }
  else if (m.stage == 1) {
    @ONE_BEND@
    if (element < C) pair_impulse(element);
  }
  else if (m.stage == 2) { if (element < N) integrate(element, period, alpha, time); }
  else if (m.stage == 3) { if (element < H) hold(element, period, sub, time + h); }
  else if (element < 3 * N) record(period, element);
"""
