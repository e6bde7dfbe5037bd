"""The simulator's substep as C++ text for one native Warp function, CPU and CUDA from this one source.

A `Lane` is sixteen (or one) worlds side by side on CPU and one float on CUDA. Semi-implicit Euler
(paper III-A):  v += h (f/m + g);  x += h v.  Forces are scattered from springs and bends to particles.

Placeholders in @ @ are filled by `kernel.py` with the traced laws of the effects in play.
"""

PRELUDE = r"""
#if defined(__CUDA_ARCH__) || @SCALAR@
  typedef float Lane;
  const int LANES = 1;
  auto lane_sqrt = [](Lane a) -> Lane { return sqrtf(a); };
  auto lane_select = [](bool c, Lane a, Lane b) -> Lane { return c ? a : b; };
  auto lane_exp = [](Lane a) -> Lane { return expf(a); };
  auto lane_sin = [](Lane a) -> Lane { return sinf(a); };
  auto lane_round = [](Lane a) -> Lane { return rintf(a); };
  auto lane_cos = [](Lane a) -> Lane { return cosf(a); };
#else
  typedef float Lane __attribute__((ext_vector_type(@LANES@)));
  const int LANES = @LANES@;
  auto lane_sqrt = [](Lane a) -> Lane { return __builtin_elementwise_sqrt(a); };
  auto lane_select = [](auto c, Lane a, Lane b) -> Lane { return c ? a : b; };
  auto lane_exp = [](Lane a) -> Lane { for (int k = 0; k < LANES; ++k) a[k] = expf(a[k]); return a; };
  auto lane_round = [](Lane a) -> Lane { return __builtin_elementwise_rint(a); };
  auto lane_sin = [](Lane a) -> Lane { for (int k = 0; k < LANES; ++k) a[k] = sinf(a[k]); return a; };
  auto lane_cos = [](Lane a) -> Lane { for (int k = 0; k < LANES; ++k) a[k] = cosf(a[k]); return a; };
#endif
  auto lane_min = [&](Lane a, Lane b) -> Lane { return lane_select(a < b, a, b); };
  auto lane_max = [&](Lane a, Lane b) -> Lane { return lane_select(a > b, a, b); };
  const Lane zero = Lane(0.0f), one = Lane(1.0f), tiny = Lane(1e-18f);

  // Model: shared by all worlds.
  const int* springs = (const int*)m.springs.data;              // (S, 2)
  const float* spring_data = (const float*)m.spring_data.data;  // (S, 5) 1/l0, l0, stiffness, damping scale, arc
  const int* bends = (const int*)m.bends.data;                  // (B, 4) before, at, after, starts a line
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
  Lane* X = (Lane*)w.position.data + (size_t)block * N * 3;
  Lane* V = (Lane*)w.velocity.data + (size_t)block * N * 3;
  Lane* A = (Lane*)w.force.data + (size_t)block * N * 3;
  const Lane* mass = (const Lane*)w.mass.data + (size_t)block * N;
  const Lane* P = (const Lane*)w.parameters.data + (size_t)block * Q;
  const Lane* spring_mask = m.masked ? (const Lane*)w.spring_mask.data + (size_t)block * S : (const Lane*)0;
  const Lane* held_mask = (const Lane*)w.held_mask.data + (size_t)block * H;
  const Lane* held_offset = (const Lane*)w.held_offset.data + (size_t)block * H * 3;
  const Lane* grips = (const Lane*)w.grips.data + (size_t)block * (T + 1) * G * 8;  // (T+1, G, 8) p, q wxyz, closed
  Lane* out = (Lane*)w.trajectory_out.data + (size_t)block * T * N * 3;
  const Lane stiffness = P[0], damping = P[1], friction = P[2], bending = P[3];

  // CPU: one thread adds. CUDA: springs of one particle run at the same time.
  auto add = [](Lane* target, Lane value) {
#if defined(__CUDA_ARCH__)
    atomicAdd(target, value);
#else
    *target += value;
#endif
  };
"""

SPRING = r"""
  auto spring_force = [&](int s, Lane time) {
    const int i = springs[2 * s], j = springs[2 * s + 1];
    const float* e = spring_data + 5 * s;
    const Lane dx = X[3 * j] - X[3 * i], dy = X[3 * j + 1] - X[3 * i + 1], dz = X[3 * j + 2] - X[3 * i + 2];
    const Lane ux = V[3 * j] - V[3 * i], uy = V[3 * j + 1] - V[3 * i + 1], uz = V[3 * j + 2] - V[3 * i + 2];
    const Lane length = lane_sqrt(dx * dx + dy * dy + dz * dz + tiny);
    const Lane inverse = one / length;
    const Lane rate = (ux * dx + uy * dy + uz * dz) * inverse;
    const Lane k = stiffness * e[2], c = damping * e[3];
    Lane tension = k * (length * e[0] - one) + c * rate;
    @SPRING@
    if (spring_mask) tension = tension * spring_mask[s];
    const Lane g = tension * inverse;
    const Lane fx = g * dx, fy = g * dy, fz = g * dz;
    add(A + 3 * i, fx); add(A + 3 * i + 1, fy); add(A + 3 * i + 2, fz);
    add(A + 3 * j, -fx); add(A + 3 * j + 1, -fy); add(A + 3 * j + 2, -fz);
  };
"""

# E = EI/(2 lbar) |kb|^2 with the curvature binormal kb = 2 t1 x t2 / (1 + t1.t2) (Bergou et al. 2008, eq. 1);
# with c = t1.t2, |kb|^2 = 4 (1-c)/(1+c).
BEND = r"""
  auto bend_force = [&](int b, Lane time) {
    const int i = bends[4 * b], j = bends[4 * b + 1], k = bends[4 * b + 2];
    const float* e = bend_data + 4 * b;
    Lane ax = X[3 * j] - X[3 * i], ay = X[3 * j + 1] - X[3 * i + 1], az = X[3 * j + 2] - X[3 * i + 2];
    Lane bx = X[3 * k] - X[3 * j], by = X[3 * k + 1] - X[3 * j + 1], bz = X[3 * k + 2] - X[3 * j + 2];
    const Lane inverse_a = one / lane_sqrt(ax * ax + ay * ay + az * az + tiny);
    const Lane inverse_b = one / lane_sqrt(bx * bx + by * by + bz * bz + tiny);
    ax *= inverse_a; ay *= inverse_a; az *= inverse_a;
    bx *= inverse_b; by *= inverse_b; bz *= inverse_b;
    const Lane c = ax * bx + ay * by + az * bz;
    // A fold beyond 178 degrees has no finite curvature: the force is bounded there.
    const Lane q = one / lane_max(one + c, Lane(3e-4f));
    // dE/dt1 = alpha t2 , dE/dt2 = alpha t1; components along t1 (t2) do no work.
    const Lane weight = bending * e[0];
    const Lane alpha = Lane(-4.0f) * weight * q * q;
    Lane gax = alpha * bx, gay = alpha * by, gaz = alpha * bz;
    Lane gbx = alpha * ax, gby = alpha * ay, gbz = alpha * az;
    @BEND_FRAME@
    @BEND@
    @BEND_MOMENT@
    const Lane pa = gax * ax + gay * ay + gaz * az, pb = gbx * bx + gby * by + gbz * bz;
    gax = (gax - pa * ax) * inverse_a; gay = (gay - pa * ay) * inverse_a; gaz = (gaz - pa * az) * inverse_a;
    gbx = (gbx - pb * bx) * inverse_b; gby = (gby - pb * by) * inverse_b; gbz = (gbz - pb * bz) * inverse_b;
    add(A + 3 * i, gax); add(A + 3 * i + 1, gay); add(A + 3 * i + 2, gaz);
    add(A + 3 * j, gbx - gax); add(A + 3 * j + 1, gby - gay); add(A + 3 * j + 2, gbz - gaz);
    add(A + 3 * k, -gbx); add(A + 3 * k + 1, -gby); add(A + 3 * k + 2, -gbz);
  };
"""

# Material frame of a line: the director u is fixed in the gripper that holds the line's first edge (else its last,
# else swung from the vertical), carried along the edges by parallel transport (Bishop frame). When both ends are
# held, the angle phi between the carried frame and the far gripper's is spread evenly over the arc length:
# twist waves are far faster than bending, so twist is quasi-static and uniform (Bergou et al. 2008, sec. 4.2.2).
FRAME = r"""
  Lane* memory = (Lane*)w.memory.data + (size_t)block * m.memory_count;  // phi, then (slot, B)
  const Lane* frame_grip = (const Lane*)w.frame_grip.data + (size_t)block * 2;  // gripper at first, last edge; -1 none
  Lane ux = zero, uy = zero, uz = zero, twist = zero;
  bool fresh = false;
  auto lane_atan2 = [&](Lane y, Lane x) -> Lane {  // 1e-5 rad
    const Lane ax = lane_max(x, -x), ay = lane_max(y, -y);
    const Lane a = lane_min(ax, ay) / lane_max(lane_max(ax, ay), tiny), s = a * a;
    Lane r = a * (0.99997726f + s * (-0.33262347f + s * (0.19354346f + s * (-0.11643287f + s * (0.05265332f - s * 0.01172120f)))));
    r = lane_select(ay > ax, 1.57079633f - r, r);
    r = lane_select(x < zero, 3.14159265f - r, r);
    return lane_select(y < zero, -r, r);
  };
  auto tangent = [&](int i, int j, Lane& tx, Lane& ty, Lane& tz) {
    tx = X[3 * j] - X[3 * i]; ty = X[3 * j + 1] - X[3 * i + 1]; tz = X[3 * j + 2] - X[3 * i + 2];
    const Lane inverse = one / lane_sqrt(tx * tx + ty * ty + tz * tz + tiny);
    tx *= inverse; ty *= inverse; tz *= inverse;
  };
  // A unit vector across t that turns with gripper `which` (a lane of indices); -1: world y swung from the vertical to t.
  // The gripper's y axis: across the object both for tools that hold it along x (jaws) and along z (collets).
  auto clamp_director = [&](Lane which, float up, int period, float alpha, Lane tx, Lane ty, Lane tz, Lane& dx, Lane& dy, Lane& dz) {
    const Lane fold = -ty / lane_max(one + up * tz, Lane(1e-3f));
    dx = fold * tx; dy = one + fold * ty; dz = fold * (tz + up);
    for (int g = 0; g < G; ++g) {
      const Lane* g0 = grips + (period * G + g) * 8;
      const Lane* g1 = grips + ((period + 1) * G + g) * 8;
      const float beta = 1.0f - alpha;
      Lane qw = beta * g0[3] + alpha * g1[3], qx = beta * g0[4] + alpha * g1[4], qy = beta * g0[5] + alpha * g1[5],
           qz = beta * g0[6] + alpha * g1[6];
      const Lane norm = 2.0f / lane_max(qw * qw + qx * qx + qy * qy + qz * qz, tiny);
      const auto here = which == Lane((float)g);
      dx = lane_select(here, norm * (qx * qy - qw * qz), dx);
      dy = lane_select(here, one - norm * (qx * qx + qz * qz), dy);
      dz = lane_select(here, norm * (qy * qz + qw * qx), dz);
    }
    const Lane along = dx * tx + dy * ty + dz * tz;
    dx -= along * tx; dy -= along * ty; dz -= along * tz;
    const Lane inverse = one / lane_sqrt(dx * dx + dy * dy + dz * dz + tiny);
    dx *= inverse; dy *= inverse; dz *= inverse;
  };
  auto carry = [&](Lane ax, Lane ay, Lane az, Lane bx, Lane by, Lane bz, Lane& dx, Lane& dy, Lane& dz) {
    const Lane k = (dx * bx + dy * by + dz * bz) / lane_max(one + ax * bx + ay * by + az * bz, Lane(3e-4f));
    dx -= k * (ax + bx); dy -= k * (ay + by); dz -= k * (az + bz);
  };
  // Sets u at the first edge and the twist angle from the first to the last edge.
  auto start_frame = [&](int period, float alpha) {
    const Lane first = frame_grip[0], last = frame_grip[1];
    Lane ax, ay, az, bx, by, bz, rx, ry, rz;
    tangent(bends[0], bends[1], ax, ay, az);
    clamp_director(first, -1.0f, period, alpha, ax, ay, az, ux, uy, uz);
    Lane dx = ux, dy = uy, dz = uz;
    for (int b = 0; b < B; ++b) {
      tangent(bends[4 * b + 1], bends[4 * b + 2], bx, by, bz);
      carry(ax, ay, az, bx, by, bz, dx, dy, dz);
      ax = bx; ay = by; az = bz;
    }
    clamp_director(last, 1.0f, period, alpha, bx, by, bz, rx, ry, rz);
    const Lane wx = by * dz - bz * dy, wy = bz * dx - bx * dz, wz = bx * dy - by * dx;
    const Lane angle = lane_atan2(rx * wx + ry * wy + rz * wz, rx * dx + ry * dy + rz * dz);
    const Lane known = fresh ? zero : memory[0];
    Lane change = angle - known;
    change -= 6.283185307f * lane_round(change * 0.159154943f);
    const auto both = lane_select(first >= zero, last, first) >= zero;
    memory[0] = lane_select(both, known + change, zero);
    twist = memory[0];
  };
"""

# Curvature components in the director frame and their change since the last substep; then the laws add moments.
BEND_FRAME = r"""
    Lane ex = ux, ey = uy, ez = uz;
    carry(ax, ay, az, bx, by, bz, ex, ey, ez);
    { // the uniform twist over this bend: cos and sin to 1e-6 for angles below 0.7 rad
      const Lane turn = twist * e[3], t2 = turn * turn;
      const Lane sn = turn * (one - t2 * (one - t2 * (1.0f / 20.0f) * (one - t2 * (1.0f / 42.0f))) * (1.0f / 6.0f));
      const Lane cs = one - t2 * 0.5f * (one - t2 * (1.0f / 12.0f) * (one - t2 * (1.0f / 30.0f)));
      const Lane wx = by * ez - bz * ey, wy = bz * ex - bx * ez, wz = bx * ey - by * ex;
      ex = cs * ex + sn * wx; ey = cs * ey + sn * wy; ez = cs * ez + sn * wz;
    }
    // Axes at the bend: mean of the two edges' frames.
    const Lane d1x = 0.5f * (ux + ex), d1y = 0.5f * (uy + ey), d1z = 0.5f * (uz + ez);
    const Lane d2x = 0.5f * (ay * uz - az * uy + by * ez - bz * ey), d2y = 0.5f * (az * ux - ax * uz + bz * ex - bx * ez),
               d2z = 0.5f * (ax * uy - ay * ux + bx * ey - by * ex);
    ux = ex; uy = ey; uz = ez;
    const Lane kx = 2.0f * q * (ay * bz - az * by), ky = 2.0f * q * (az * bx - ax * bz), kz = 2.0f * q * (ax * by - ay * bx);
    const Lane k1 = kx * d1x + ky * d1y + kz * d1z, k2 = kx * d2x + ky * d2y + kz * d2z;
    Lane* last = memory + 1 + 2 * b;
    const Lane change1 = fresh ? zero : k1 - last[0], change2 = fresh ? zero : k2 - last[1];
    last[0] = k1; last[1] = k2;
    Lane moment1 = zero, moment2 = zero;
"""

# Forces of the moments: the gradient of kb.M with M = moment1 d1 + moment2 d2 held fixed.
BEND_MOMENT = r"""
    {
      const Lane Mx = moment1 * d1x + moment2 * d2x, My = moment1 * d1y + moment2 * d2y, Mz = moment1 * d1z + moment2 * d2z;
      const Lane u = (ay * bz - az * by) * Mx + (az * bx - ax * bz) * My + (ax * by - ay * bx) * Mz;
      const Lane g = 2.0f * q, uq = u * q;
      gax += g * (by * Mz - bz * My - uq * bx); gay += g * (bz * Mx - bx * Mz - uq * by); gaz += g * (bx * My - by * Mx - uq * bz);
      gbx += g * (My * az - Mz * ay - uq * ax); gby += g * (Mz * ax - Mx * az - uq * ay); gbz += g * (Mx * ay - My * ax - uq * az);
    }
"""

# Contact: the velocity after the substep may not carry the particle through the surface. Where it would,
# the normal velocity is cut to what reaches the surface, and Coulomb friction takes at most mu times that cut
# from the sliding velocity. Convex shapes cannot be tunnelled: their signed distance is a convex function.
CONTACT = r"""
  auto press = [&](Lane gap, Lane nx, Lane ny, Lane nz, Lane sx, Lane sy, Lane sz, Lane mu,
                   Lane& vx, Lane& vy, Lane& vz) -> Lane {
    // gap [m], outward normal n, surface velocity s; returns how far the particle is inside.
    const Lane rx = vx - sx, ry = vy - sy, rz = vz - sz;
    const Lane vn = rx * nx + ry * ny + rz * nz;
    const Lane cut = lane_max(-lane_max(gap, zero) * (1.0f / h) - vn, zero);
    const Lane tx = rx - vn * nx, ty = ry - vn * ny, tz = rz - vn * nz;
    const Lane slide = lane_sqrt(tx * tx + ty * ty + tz * tz + tiny);
    const Lane keep = lane_max(one - mu * cut / slide, zero) - one;
    vx += cut * nx + keep * tx; vy += cut * ny + keep * ty; vz += cut * nz + keep * tz;
    return lane_max(-gap, zero);
  };
  auto fixture_gap = [&](int f, Lane x, Lane y, Lane z, Lane& nx, Lane& ny, Lane& nz) -> Lane {
    const float* d = fixture_data + 16 * f;
    if (fixture_shape[f] < 2) {  // sphere, capsule: d = start, end, radius
      const float ex = d[3] - d[0], ey = d[4] - d[1], ez = d[5] - d[2];
      const float square = ex * ex + ey * ey + ez * ez;
      Lane s = square > 0.0f ? ((x - d[0]) * ex + (y - d[1]) * ey + (z - d[2]) * ez) * (1.0f / square) : zero;
      s = lane_min(lane_max(s, zero), one);
      nx = x - d[0] - s * ex; ny = y - d[1] - s * ey; nz = z - d[2] - s * ez;
      const Lane distance = lane_sqrt(nx * nx + ny * ny + nz * nz + tiny);
      const Lane inverse = one / distance;
      nx *= inverse; ny *= inverse; nz *= inverse;
      return distance - d[6];
    }
    // Box: d = center, half size, rows of box_from_world.
    const Lane rx = x - d[0], ry = y - d[1], rz = z - d[2];
    const Lane lx = d[6] * rx + d[7] * ry + d[8] * rz;
    const Lane ly = d[9] * rx + d[10] * ry + d[11] * rz;
    const Lane lz = d[12] * rx + d[13] * ry + d[14] * rz;
    const Lane gx = lane_select(lx < zero, -one, one), gy = lane_select(ly < zero, -one, one),
               gz = lane_select(lz < zero, -one, one);
    const Lane qx = gx * lx - d[3], qy = gy * ly - d[4], qz = gz * lz - d[5];
    const Lane ox = lane_max(qx, zero), oy = lane_max(qy, zero), oz = lane_max(qz, zero);
    const Lane outside = lane_sqrt(ox * ox + oy * oy + oz * oz);
    const Lane inside = lane_min(lane_max(qx, lane_max(qy, qz)), zero);
    const auto is_out = outside > zero;
    const Lane inverse = one / lane_max(outside, Lane(1e-12f));
    const Lane fx = lane_select(qx >= inside, one, zero);  // inside: the nearest face
    const Lane fy = lane_select(qy >= inside, one - fx, zero);
    const Lane fz = one - fx - fy;
    const Lane mx = gx * lane_select(is_out, ox * inverse, fx), my = gy * lane_select(is_out, oy * inverse, fy),
               mz = gz * lane_select(is_out, oz * inverse, fz);
    nx = d[6] * mx + d[9] * my + d[12] * mz;
    ny = d[7] * mx + d[10] * my + d[13] * mz;
    nz = d[8] * mx + d[11] * my + d[14] * mz;
    return outside + inside;
  };
"""

# Approaching pairs closer than two radii exchange the impulse that stops their approach.
SELF_COLLISION = r"""
  auto pair_impulse = [&](int c) {
    const int i = pairs[2 * c], j = pairs[2 * c + 1];
    const Lane dx = X[3 * j] - X[3 * i], dy = X[3 * j + 1] - X[3 * i + 1], dz = X[3 * j + 2] - X[3 * i + 2];
    const Lane length = lane_sqrt(dx * dx + dy * dy + dz * dz + tiny);
    const Lane inverse = one / length;
    const Lane rate = ((V[3 * j] - V[3 * i]) * dx + (V[3 * j + 1] - V[3 * i + 1]) * dy +
                       (V[3 * j + 2] - V[3 * i + 2]) * dz) * inverse;
    const Lane gap = length - m.contact_distance;
    // Least impulse after which the pair is not closer than contact within this substep; deep pairs part at 1/20 a substep.
    const Lane wanted = lane_select(gap > zero, -gap * (1.0f / h), -gap * (0.05f / h));
    const Lane missing = lane_max(wanted - rate, zero);
    const Lane impulse = missing * mass[i] * mass[j] / (mass[i] + mass[j]);
    const Lane g = impulse * inverse * (1.0f / h);
    add(A + 3 * i, -g * dx); add(A + 3 * i + 1, -g * dy); add(A + 3 * i + 2, -g * dz);
    add(A + 3 * j, g * dx); add(A + 3 * j + 1, g * dy); add(A + 3 * j + 2, g * dz);
  };
"""

PARTICLE = r"""
  auto integrate = [&](int i, int period, float alpha, Lane time) {
    const Lane m_i = mass[i];
    const float* e = particle_data + 2 * i;
    Lane x = X[3 * i], y = X[3 * i + 1], z = X[3 * i + 2];
    Lane vx = V[3 * i], vy = V[3 * i + 1], vz = V[3 * i + 2];
    Lane fx = A[3 * i], fy = A[3 * i + 1], fz = A[3 * i + 2];
    @FORCE@
    const Lane gain = h / m_i;
    vx += fx * gain + h * m.gravity_x; vy += fy * gain + h * m.gravity_y; vz += fz * gain + h * m.gravity_z;
    const Lane mu0 = friction * e[0];
    Lane px = zero, py = zero, pz = zero;  // way out of a surface the particle is inside of
    if (m.has_ground) {
      Lane mu = mu0, ground = Lane(m.ground);
      @CONTACT@
      const Lane depth = press(z - ground - m.radius, zero, zero, one, zero, zero, zero, mu, vx, vy, vz);
      pz += depth;
    }
    for (int f = 0; f < F; ++f) {
      Lane nx, ny, nz;
      const Lane gap = fixture_gap(f, x, y, z, nx, ny, nz) - m.radius;
      const Lane depth = press(gap, nx, ny, nz, zero, zero, zero, mu0, vx, vy, vz);
      px += depth * nx; py += depth * ny; pz += depth * nz;
    }
    if (m.pusher_radius > 0.0f) {
      for (int g = 0; g < G; ++g) {
        const Lane* g0 = grips + (period * G + g) * 8;
        const Lane* g1 = grips + ((period + 1) * G + g) * 8;
        const Lane sx = (g1[0] - g0[0]) * m.inverse_period, sy = (g1[1] - g0[1]) * m.inverse_period,
                   sz = (g1[2] - g0[2]) * m.inverse_period;
        Lane nx = x - g0[0] - alpha * (g1[0] - g0[0]), ny = y - g0[1] - alpha * (g1[1] - g0[1]),
             nz = z - g0[2] - alpha * (g1[2] - g0[2]);
        const Lane distance = lane_sqrt(nx * nx + ny * ny + nz * nz + tiny);
        const Lane inverse = one / distance;
        nx *= inverse; ny *= inverse; nz *= inverse;
        // A closed gripper holds, an open one pushes.
        const Lane gap = lane_select(g1[7] > Lane(0.5f), Lane(1e9f), distance - m.pusher_radius - m.radius);
        const Lane depth = press(gap, nx, ny, nz, sx, sy, sz, mu0, vx, vy, vz);
        px += depth * nx; py += depth * ny; pz += depth * nz;
      }
    }
    X[3 * i] = x + h * vx + px; X[3 * i + 1] = y + h * vy + py; X[3 * i + 2] = z + h * vz + pz;
    V[3 * i] = vx; V[3 * i + 1] = vy; V[3 * i + 2] = vz;
    A[3 * i] = zero; A[3 * i + 1] = zero; A[3 * i + 2] = zero;
  };
"""

HELD = r"""
  auto target = [&](int entry, int period, float alpha, Lane time, Lane& x, Lane& y, Lane& z) {
    const int g = held[2 * entry + 1];
    const Lane* g0 = grips + (period * G + g) * 8;
    const Lane* g1 = grips + ((period + 1) * G + g) * 8;
    const Lane* o = held_offset + 3 * entry;
    const float beta = 1.0f - alpha;
    Lane qw = beta * g0[3] + alpha * g1[3], qx = beta * g0[4] + alpha * g1[4], qy = beta * g0[5] + alpha * g1[5],
         qz = beta * g0[6] + alpha * g1[6];
    const Lane norm = one / lane_sqrt(qw * qw + qx * qx + qy * qy + qz * qz + tiny);
    qw *= norm; qx *= norm; qy *= norm; qz *= norm;
    const Lane tx = 2.0f * (qy * o[2] - qz * o[1]), ty = 2.0f * (qz * o[0] - qx * o[2]),
               tz = 2.0f * (qx * o[1] - qy * o[0]);
    const Lane lx = o[0] + qw * tx + qy * tz - qz * ty, ly = o[1] + qw * ty + qz * tx - qx * tz,
               lz = o[2] + qw * tz + qx * ty - qy * tx;
    x = beta * g0[0] + alpha * g1[0] + lx;
    y = beta * g0[1] + alpha * g1[1] + ly;
    z = beta * g0[2] + alpha * g1[2] + lz;
    @BOUNDARY@
  };
  auto hold = [&](int entry, int period, int sub, Lane time) {
    const int i = held[2 * entry];
    const float alpha = (sub + 1) * m.inverse_substeps, before = sub * m.inverse_substeps;
    Lane x, y, z, bx, by, bz;
    target(entry, period, alpha, time, x, y, z);
    target(entry, period, before, time - h, bx, by, bz);
    const auto on = held_mask[entry] > Lane(0.5f);
    X[3 * i] = lane_select(on, x, X[3 * i]);
    X[3 * i + 1] = lane_select(on, y, X[3 * i + 1]);
    X[3 * i + 2] = lane_select(on, z, X[3 * i + 2]);
    V[3 * i] = lane_select(on, (x - bx) * (1.0f / h), V[3 * i]);
    V[3 * i + 1] = lane_select(on, (y - by) * (1.0f / h), V[3 * i + 1]);
    V[3 * i + 2] = lane_select(on, (z - bz) * (1.0f / h), V[3 * i + 2]);
  };
"""

# All periods and substeps of one block of worlds in one call (CPU).
FUSED = r"""
  for (int period = 0; period < T; ++period) {
    for (int sub = 0; sub < m.substeps; ++sub) {
      const Lane time = Lane(m.time + ((float)period * m.substeps + sub) * h);
      for (int s = 0; s < S; ++s) spring_force(s, time);
      const float alpha = sub * m.inverse_substeps;
      @BEND_START@
      for (int b = 0; b < B; ++b) bend_force(b, time);
      for (int c = 0; c < C; ++c) pair_impulse(c);
      for (int i = 0; i < N; ++i) integrate(i, period, alpha, time);
      for (int e = 0; e < H; ++e) hold(e, period, sub, time + h);
    }
    for (int k = 0; k < 3 * N; ++k) out[(size_t)period * 3 * N + k] = X[k];
  }
"""

# One stage of one substep for one element of one world (CUDA): 0 springs, 1 bends and pairs, 2 particles, 3 held,
# 4 record the period. The period's number is read from the device, so that one recorded period can be replayed.
STAGED = r"""
  const int period = ((const int*)w.clock.data)[0], sub = m.stage_sub;
  const Lane time = Lane(m.time + ((float)period * m.substeps + sub) * h);
  if (m.stage == 0) { if (element < S) spring_force(element, time); }
  else if (m.stage == 1) {
    if (element == 0) {
      const float alpha = sub * m.inverse_substeps;
      @BEND_START@
      for (int b = 0; b < B; ++b) bend_force(b, time);
    }
    if (element < C) pair_impulse(element);
  }
  else if (m.stage == 2) { if (element < N) integrate(element, period, sub * m.inverse_substeps, time); }
  else if (m.stage == 3) { if (element < H) hold(element, period, sub, time + h); }
  else if (element < 3 * N) out[(size_t)period * 3 * N + element] = X[element];
"""
