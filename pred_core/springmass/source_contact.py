"""Contact, self-collision, particles and grippers as C++ text; see `source.py`."""

# Speed [m/s] at which a particle that begins inside a surface leaves it. All at once, the damping of a bend would take
# the way out for a motion within one substep and throw the neighbours up, by EI tau / l^2 over their mass a radian.
WAY_OUT = 0.1

# Contact: the velocity after the substep may not carry the particle through the surface. Where it would,
# the normal velocity is cut to what reaches the surface, and Coulomb friction takes at most mu times that cut
# from the sliding velocity. Convex shapes cannot be tunnelled: their signed distance is a convex function.
CONTACT = r"""
  auto press = [&](Lane gap, Lane nx, Lane ny, Lane nz, Lane sx, Lane sy, Lane sz, Lane mu,
                   Lane& vx, Lane& vy, Lane& vz) -> Lane {
    // gap [m], outward normal n, surface velocity s; returns how far a particle inside moves out in this substep.
    const Lane rx = vx - sx, ry = vy - sy, rz = vz - sz;
    const Lane vn = rx * nx + ry * ny + rz * nz;
    const Lane cut = lane_max(-lane_max(gap, zero) * (1.0f / h) - vn, zero);
    const Lane tx = rx - vn * nx, ty = ry - vn * ny, tz = rz - vn * nz;
    const Lane slide = lane_sqrt(tx * tx + ty * ty + tz * tz + tiny);
    const Lane keep = lane_max(one - mu * cut / slide, zero) - one;
    vx += cut * nx + keep * tx; vy += cut * ny + keep * ty; vz += cut * nz + keep * tz;
    return lane_min(lane_max(-gap, zero), Lane(@WAY_OUT@f * h));
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
""".replace("@WAY_OUT@", str(WAY_OUT))

# Approaching pairs closer than two radii exchange the impulse that stops their approach.
SELF_COLLISION = r"""
  auto pair_impulse = [&](int c) {
    const int i = pairs[2 * c], j = pairs[2 * c + 1];
    const Lane dx = X[D * j] - X[D * i], dy = X[D * j + 1] - X[D * i + 1], dz = X[D * j + 2] - X[D * i + 2];
    const Lane length = lane_sqrt(dx * dx + dy * dy + dz * dz + tiny);
    const Lane inverse = one / length;
    const Lane rate = ((V[D * j] - V[D * i]) * dx + (V[D * j + 1] - V[D * i + 1]) * dy +
                       (V[D * j + 2] - V[D * i + 2]) * dz) * inverse;
    const Lane gap = length - m.contact_distance;
    // Least impulse after which the pair is not closer than contact; deep pairs part by 1/20 a substep.
    const Lane wanted = lane_select(gap > zero, -gap * (1.0f / h), -gap * (0.05f / h));
    const Lane missing = lane_max(wanted - rate, zero);
    const Lane impulse = missing * mass[i] * mass[j] / (mass[i] + mass[j]);
    const Lane g = impulse * inverse * (1.0f / h);
    add(A + D * i, -g * dx); add(A + D * i + 1, -g * dy); add(A + D * i + 2, -g * dz);
    add(A + D * j, g * dx); add(A + D * j + 1, g * dy); add(A + D * j + 2, g * dz);
  };
"""

PARTICLE = r"""
  auto integrate = [&](int i, int period, float alpha, Lane time) {
    const Lane m_i = mass[i];
    const float* e = particle_data + 2 * i;
    Lane x = X[D * i], y = X[D * i + 1], z = X[D * i + 2];
    Lane vx = V[D * i], vy = V[D * i + 1], vz = V[D * i + 2];
    Lane fx = A[D * i], fy = A[D * i + 1], fz = A[D * i + 2];
    @FORCE@
    @LOAD@
    const Lane gain = h * inverse_mass[i];
    vx += fx * gain + h * m.gravity_x; vy += fy * gain + h * m.gravity_y; vz += fz * gain + h * m.gravity_z;
    const Lane mu0 = friction * e[0];
    Lane px = zero, py = zero, pz = zero;  // way out of a surface the particle is inside of
    // What cannot move comes last, so that the pusher does not drive a particle through it.
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
    for (int f = 0; f < F; ++f) {
      Lane nx, ny, nz;
      const Lane gap = fixture_gap(f, x, y, z, nx, ny, nz) - m.radius;
      const Lane depth = press(gap, nx, ny, nz, zero, zero, zero, mu0, vx, vy, vz);
      px += depth * nx; py += depth * ny; pz += depth * nz;
    }
    if (m.has_ground) {
      Lane mu = mu0, ground = Lane(m.ground);
      @CONTACT@
      const Lane depth = press(z - ground - m.radius, zero, zero, one, zero, zero, zero, mu, vx, vy, vz);
      pz += depth;
    }
    X[D * i] = x + h * vx + px; X[D * i + 1] = y + h * vy + py; X[D * i + 2] = z + h * vz + pz;
    V[D * i] = vx; V[D * i + 1] = vy; V[D * i + 2] = vz;
    A[D * i] = zero; A[D * i + 1] = zero; A[D * i + 2] = zero;
  };
"""

# What all forces but contact do to a particle, kept for the pull on what is held; and where grips keep their memory.
LOAD = "load[3 * i] = fx + m_i * m.gravity_x; load[3 * i + 1] = fy + m_i * m.gravity_y; " \
       "load[3 * i + 2] = fz + m_i * m.gravity_z;"  # fmt: skip
GRIP_MEMORY = r"""
  Lane* load = (Lane*)w.load.data + (size_t)block * N * 3;
  Lane* grip_memory = (Lane*)w.memory.data + (size_t)block * m.memory_count + m.memory_count - @GRIP_SLOTS@ * N;
"""
# The pull on all that the gripper of this entry holds, its mass, and the gripper's turn at the end of the substep.
PULL = r"""
    Lane pull_x = zero, pull_y = zero, pull_z = zero, pulled_mass = zero;
    for (int other = 0; other < H; ++other) {
      if (held[2 * other + 1] != g) continue;
      const Lane share = lane_select(held_mask[other] > Lane(0.5f), one, zero);
      const Lane* of = load + 3 * held[2 * other];
      pull_x += share * of[0]; pull_y += share * of[1]; pull_z += share * of[2];
      pulled_mass += share * mass[held[2 * other]];
    }
    pulled_mass = lane_max(pulled_mass, tiny);  // lanes that hold nothing here
    Lane qw = beta * g0[3] + alpha * g1[3], qx = beta * g0[4] + alpha * g1[4], qy = beta * g0[5] + alpha * g1[5],
         qz = beta * g0[6] + alpha * g1[6];
    const Lane turn = one / lane_sqrt(qw * qw + qx * qx + qy * qy + qz * qz + tiny);
    qw *= turn; qx *= turn; qy *= turn; qz *= turn;
"""

HELD = r"""
  // Where a held particle is from its gripper's origin, in world axes: its lever and what boundary laws add.
  auto lever = [&](int entry, int period, float alpha, Lane time, Lane& rx, Lane& ry, Lane& rz) {
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
    rx = lx; ry = ly; rz = lz;
    @BOUNDARY@
  };
  auto hold = [&](int entry, int period, int sub, Lane time) {
    const auto on = held_mask[entry] > Lane(0.5f);
#if defined(__CUDA_ARCH__) || @SCALAR@
    if (!on) return;  // another entry may hold this particle at the same time
#endif
    const int i = held[2 * entry], g = held[2 * entry + 1];
    const Lane* g0 = grips + (period * G + g) * 8;
    const Lane* g1 = grips + ((period + 1) * G + g) * 8;
    const float alpha = (sub + 1) * m.inverse_substeps, beta = 1.0f - alpha;
    Lane* before = held_lever + 3 * entry;
    if (sub == 0) lever(entry, period, 0.0f, time - h, before[0], before[1], before[2]);
    @SLIDE@
    Lane r[3];
    lever(entry, period, alpha, time, r[0], r[1], r[2]);
    for (int k = 0; k < 3; ++k) {
      const Lane speed = (g1[k] - g0[k]) * m.inverse_period + (r[k] - before[k]) * (1.0f / h);
      X[D * i + k] = lane_select(on, beta * g0[k] + alpha * g1[k] + r[k], X[D * i + k]);
      V[D * i + k] = lane_select(on, speed, V[D * i + k]);
      before[k] = r[k];
    }
  };
"""
