"""Bending by angle and the material frame of a line as C++ text; see `source.py`."""

# E = EI/(2 lbar) |kb|^2 with the curvature binormal kb = 2 t1 x t2 / (1 + t1.t2) (Bergou et al. 2008, eq. 1);
# with c = t1.t2, |kb|^2 = 4 (1-c)/(1+c).
BEND = r"""
  auto bend_force = [&](int b, Lane time) {
    const int i = bends[3 * b], j = bends[3 * b + 1], k = bends[3 * b + 2];
    const float* e = bend_data + 4 * b;
    Lane ax = X[D * j] - X[D * i], ay = X[D * j + 1] - X[D * i + 1], az = X[D * j + 2] - X[D * i + 2];
    Lane bx = X[D * k] - X[D * j], by = X[D * k + 1] - X[D * j + 1], bz = X[D * k + 2] - X[D * j + 2];
    const Lane inverse_a = one / lane_sqrt(ax * ax + ay * ay + az * az + tiny);
    const Lane inverse_b = one / lane_sqrt(bx * bx + by * by + bz * bz + tiny);
    ax *= inverse_a; ay *= inverse_a; az *= inverse_a;
    bx *= inverse_b; by *= inverse_b; bz *= inverse_b;
    @TANGENT@
    const Lane c = ax * bx + ay * by + az * bz;
    // A fold beyond 178 degrees has no finite curvature: the force is bounded there.
    const Lane q = one / lane_max(one + c, Lane(3e-4f));
    // dE/dt1 = alpha t2 , dE/dt2 = alpha t1; components along t1 (t2) do no work.
    Lane weight = bending * e[0];
    @BEND_STIFFNESS@
    const Lane alpha = Lane(-4.0f) * weight * q * q;
    Lane gax = alpha * bx, gay = alpha * by, gaz = alpha * bz;
    Lane gbx = alpha * ax, gby = alpha * ay, gbz = alpha * az;
    @BEND_FRAME@
    @BEND@
    @BEND_MOMENT@
    const Lane pa = gax * ax + gay * ay + gaz * az, pb = gbx * bx + gby * by + gbz * bz;
    gax = (gax - pa * ax) * inverse_a; gay = (gay - pa * ay) * inverse_a; gaz = (gaz - pa * az) * inverse_a;
    gbx = (gbx - pb * bx) * inverse_b; gby = (gby - pb * by) * inverse_b; gbz = (gbz - pb * bz) * inverse_b;
    add(A + D * i, gax); add(A + D * i + 1, gay); add(A + D * i + 2, gaz);
    add(A + D * j, gbx - gax); add(A + D * j + 1, gby - gay); add(A + D * j + 2, gbz - gaz);
    add(A + D * k, -gbx); add(A + D * k + 1, -gby); add(A + D * k + 2, -gbz);
  };
"""

# Material frame of a line: the director u is fixed in the gripper that holds the line's first edge (else its last;
# else carried along in time, see `start_frame`) and carried along the edges by parallel transport (Bishop frame).
# When both ends are held, the angle phi between the carried frame and the far gripper's is spread evenly over the
# arc length: twist waves are far faster than bending, so twist is quasi-static and uniform (Bergou et al. 2008,
# sec. 4.2.2).
FRAME = r"""
  const int* chains = (const int*)m.chains.data;  // (K, 2) first bend, one past the last
  const int K = m.chain_count;
  Lane* memory = (Lane*)w.memory.data + (size_t)block * m.memory_count;  // (K, 4) phi and u, (slot, B), (K, HANDED)
  const Lane* frame_grip = (const Lane*)w.frame_grip.data + (size_t)block * 2 * K;  // (K, 2) at either end, or -1
  Lane director[3] = {zero, zero, zero}, twist = zero, line_bends = zero;  // u at the edge before the next bend
  Lane fresh = zero;  // 1 in a world's first substep
  // What laws hand on along a line: from bend to bend in this substep, and what arrived at its end in the last one.
  constexpr int HANDED = @LINE_VALUES@;
  Lane handed[HANDED + 1], arrived[HANDED + 1], first_held = zero, last_held = zero;
  auto lane_atan2 = [&](Lane y, Lane x) -> Lane {  // 1e-5 rad
    const Lane ax = lane_max(x, -x), ay = lane_max(y, -y);
    const Lane a = lane_min(ax, ay) / lane_max(lane_max(ax, ay), tiny), s = a * a;
    Lane r = 0.05265332f - s * 0.01172120f;
    r = a * (0.99997726f + s * (-0.33262347f + s * (0.19354346f + s * (-0.11643287f + s * r))));
    r = lane_select(ay > ax, 1.57079633f - r, r);
    r = lane_select(x < zero, 3.14159265f - r, r);
    return lane_select(y < zero, -r, r);
  };
  auto tangent = [&](int i, int j, Lane& tx, Lane& ty, Lane& tz) {
    tx = X[D * j] - X[D * i]; ty = X[D * j + 1] - X[D * i + 1]; tz = X[D * j + 2] - X[D * i + 2];
    const Lane inverse = one / lane_sqrt(tx * tx + ty * ty + tz * tz + tiny);
    tx *= inverse; ty *= inverse; tz *= inverse;
  };
  // A unit vector across t that turns with gripper `which` (a lane of indices); -1: world y swung from the vertical.
  // The gripper's y axis: across the object both for tools that hold it along x (jaws) and along z (collets).
  auto clamp_director = [&](Lane which, float up, int period, float alpha, Lane tx, Lane ty, Lane tz,
                            Lane& dx, Lane& dy, Lane& dz) {
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
  auto turned = [&](Lane tx, Lane ty, Lane tz, Lane cs, Lane sn, Lane* d) {  // d turned about t, across it
    const Lane x = cs * d[0] + sn * (ty * d[2] - tz * d[1]), y = cs * d[1] + sn * (tz * d[0] - tx * d[2]);
    d[2] = cs * d[2] + sn * (tx * d[1] - ty * d[0]);
    d[0] = x; d[1] = y;
  };
  // Directors at the bend between edges a and b: the mean of the two edges' frames. Moves e on to edge b.
  auto directors = [&](Lane ax, Lane ay, Lane az, Lane bx, Lane by, Lane bz, Lane turn, Lane* e, Lane* d1, Lane* d2) {
    const Lane ox = e[0], oy = e[1], oz = e[2];
    carry(ax, ay, az, bx, by, bz, e[0], e[1], e[2]);
    // The uniform twist over this bend: cos and sin to 1e-6 for angles below 0.7 rad.
    const Lane t2 = turn * turn;
    const Lane sn = turn * (one - t2 * (one - t2 * (1.0f / 20.0f) * (one - t2 * (1.0f / 42.0f))) * (1.0f / 6.0f));
    const Lane cs = one - t2 * 0.5f * (one - t2 * (1.0f / 12.0f) * (one - t2 * (1.0f / 30.0f)));
    turned(bx, by, bz, cs, sn, e);
    d1[0] = 0.5f * (ox + e[0]); d1[1] = 0.5f * (oy + e[1]); d1[2] = 0.5f * (oz + e[2]);
    d2[0] = 0.5f * (ay * oz - az * oy + by * e[2] - bz * e[1]);
    d2[1] = 0.5f * (az * ox - ax * oz + bz * e[0] - bx * e[2]);
    d2[2] = 0.5f * (ax * oy - ay * ox + bx * e[1] - by * e[0]);
  };
  // Sets u at a line's first edge and the twist angle from its first to its last edge.
  auto start_frame = [&](int line, int period, float alpha) {
    const Lane first = frame_grip[2 * line], last = frame_grip[2 * line + 1];
    const int begin = chains[2 * line], end = chains[2 * line + 1];
    Lane* kept = memory + 4 * line;
    line_bends = Lane((float)(end - begin));
    first_held = lane_select(first < zero, zero, one); last_held = lane_select(last < zero, zero, one);
    for (int v = 0; v < HANDED; ++v) {
      handed[v] = zero; arrived[v] = lane_select(fresh > zero, zero, memory[@LINE_PLACE@ + HANDED * line + v]);
    }
    Lane sx, sy, sz, ax, ay, az, bx, by, bz, r[3], d[3], u[3];
    tangent(bends[3 * begin], bends[3 * begin + 1], sx, sy, sz);
    clamp_director(first, -1.0f, period, alpha, sx, sy, sz, u[0], u[1], u[2]);
    for (int k = 0; k < 3; ++k) d[k] = u[k];
    ax = sx; ay = sy; az = sz;
    for (int b = begin; b < end; ++b) {
      tangent(bends[3 * b + 1], bends[3 * b + 2], bx, by, bz);
      carry(ax, ay, az, bx, by, bz, d[0], d[1], d[2]);
      ax = bx; ay = by; az = bz;
    }
    clamp_director(last, 1.0f, period, alpha, ax, ay, az, r[0], r[1], r[2]);
    const Lane wx = ay * d[2] - az * d[1], wy = az * d[0] - ax * d[2], wz = ax * d[1] - ay * d[0];
    const Lane across = r[0] * wx + r[1] * wy + r[2] * wz, ahead = r[0] * d[0] + r[1] * d[1] + r[2] * d[2];
    const Lane known = lane_select(fresh > zero, zero, kept[0]);
    Lane change = lane_atan2(across, ahead) - (@END_TWIST@) - known;
    change -= 6.283185307f * lane_round(change * 0.159154943f);
    const Lane free_first = lane_select(first < zero, one, zero), free_last = lane_select(last < zero, one, zero);
    twist = lane_select(free_first + free_last > zero, zero, known + change);
    // Only the last edge is held: turn u at the first edge so that it arrives there in the gripper's direction.
    const Lane size = one / lane_sqrt(across * across + ahead * ahead + tiny);
    const auto backward = free_first - free_last > zero;
    turned(sx, sy, sz, lane_select(backward, ahead * size, one), lane_select(backward, across * size, zero), u);
    if (m.loose) {
      // Nothing is held: u of the last substep, carried in time, and turned so that curvature changes least.
      Lane e[3], d1[3], d2[3], sine = zero, cosine = zero;
      const Lane along = kept[1] * sx + kept[2] * sy + kept[3] * sz;
      e[0] = kept[1] - along * sx; e[1] = kept[2] - along * sy; e[2] = kept[3] - along * sz;
      const Lane unit = one / lane_sqrt(e[0] * e[0] + e[1] * e[1] + e[2] * e[2] + tiny);
      for (int k = 0; k < 3; ++k) e[k] = d[k] = lane_select(fresh > zero, u[k], e[k] * unit);
      ax = sx; ay = sy; az = sz;
      for (int b = begin; b < end; ++b) {
        tangent(bends[3 * b + 1], bends[3 * b + 2], bx, by, bz);
        directors(ax, ay, az, bx, by, bz, zero, e, d1, d2);
        const Lane kx = ay * bz - az * by, ky = az * bx - ax * bz, kz = ax * by - ay * bx;
        const Lane g = 2.0f / lane_max(one + ax * bx + ay * by + az * bz, Lane(3e-4f));
        const Lane k1 = g * (kx * d1[0] + ky * d1[1] + kz * d1[2]), k2 = g * (kx * d2[0] + ky * d2[1] + kz * d2[2]);
        const Lane* was = memory + 4 * K + 2 * b;
        sine += was[0] * k2 - was[1] * k1; cosine += was[0] * k1 + was[1] * k2;
        ax = bx; ay = by; az = bz;
      }
      const Lane square = sine * sine + cosine * cosine;
      const auto known_turn = square > tiny;
      const Lane inverse = one / lane_sqrt(square + tiny);
      cosine = lane_select(known_turn, cosine * inverse, one); sine = lane_select(known_turn, sine * inverse, zero);
      turned(sx, sy, sz, cosine, sine, d);
      const auto neither = free_first + free_last > Lane(1.5f);
      for (int k = 0; k < 3; ++k) u[k] = lane_select(neither, d[k], u[k]);
    }
    kept[0] = twist;
    for (int k = 0; k < 3; ++k) { kept[1 + k] = u[k]; director[k] = u[k]; }
  };
"""

# Curvature components in the director frame and their change since the last substep; then the laws add moments.
BEND_FRAME = r"""
    Lane d1[3], d2[3];
    directors(ax, ay, az, bx, by, bz, twist * e[3], director, d1, d2);
    const Lane kx = 2.0f * q * (ay * bz - az * by), ky = 2.0f * q * (az * bx - ax * bz),
               kz = 2.0f * q * (ax * by - ay * bx);
    const Lane k1 = kx * d1[0] + ky * d1[1] + kz * d1[2], k2 = kx * d2[0] + ky * d2[1] + kz * d2[2];
    Lane* last = memory + 4 * K + 2 * b;
    const Lane change1 = lane_select(fresh > zero, zero, k1 - last[0]);
    const Lane change2 = lane_select(fresh > zero, zero, k2 - last[1]);
    last[0] = k1; last[1] = k2;
    Lane moment1 = zero, moment2 = zero;
"""

# Directions of a line at its particles, where `force` laws read them: along the mean of the two edges, at an end along
# its edge. What is in no bend keeps zero.
TANGENT_BUFFER = "Lane* tangents = (Lane*)w.tangent.data + (size_t)block * N * 3;"
TANGENT = r"""
    {
      Lane sx = ax + bx, sy = ay + by, sz = az + bz;
      const Lane inverse = one / lane_sqrt(sx * sx + sy * sy + sz * sz + tiny);
      tangents[3 * j] = sx * inverse; tangents[3 * j + 1] = sy * inverse; tangents[3 * j + 2] = sz * inverse;
      if (b == 0 || bends[3 * b - 2] != i) { tangents[3 * i] = ax; tangents[3 * i + 1] = ay; tangents[3 * i + 2] = az; }
      if (b + 1 == B || bends[3 * b + 3] != j) {
        tangents[3 * k] = bx; tangents[3 * k + 1] = by; tangents[3 * k + 2] = bz;
      }
    }
"""

# Forces of the moments: the gradient of kb.M with M = moment1 d1 + moment2 d2 held fixed.
BEND_MOMENT = r"""
    {
      const Lane Mx = moment1 * d1[0] + moment2 * d2[0], My = moment1 * d1[1] + moment2 * d2[1],
                 Mz = moment1 * d1[2] + moment2 * d2[2];
      const Lane u = (ay * bz - az * by) * Mx + (az * bx - ax * bz) * My + (ax * by - ay * bx) * Mz;
      const Lane g = 2.0f * q, uq = u * q;
      gax += g * (by * Mz - bz * My - uq * bx); gay += g * (bz * Mx - bx * Mz - uq * by);
      gaz += g * (bx * My - by * Mx - uq * bz);
      gbx += g * (My * az - Mz * ay - uq * ax); gby += g * (Mz * ax - Mx * az - uq * ay);
      gbz += g * (Mx * ay - My * ax - uq * az);
    }
"""

# A line's bends follow each other, because its frame is carried from one to the next.
ALL_BENDS = "for (int b = 0; b < B; ++b) bend_force(b, time);"
ONE_BEND = "if (element < B) bend_force(element, time);"
FRAMED_LINE = r"""
        start_frame(line, period, alpha);
        for (int b = chains[2 * line]; b < chains[2 * line + 1]; ++b) bend_force(b, time);
        for (int v = 0; v < HANDED; ++v) memory[@LINE_PLACE@ + HANDED * line + v] = handed[v];
"""
FRESH = "fresh = period == 0 && sub == 0 ? lane_select(steps > zero, zero, one) : zero;"
ALL_BENDS_FRAMED = FRESH + " for (int line = 0; line < K; ++line) {" + FRAMED_LINE + "      }"
ONE_BEND_FRAMED = FRESH + " if (element < K) { const int line = element;" + FRAMED_LINE + "    }"
