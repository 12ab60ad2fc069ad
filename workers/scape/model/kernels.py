"""Inner loops in numba, where numpy would pass over memory many times.

Each call runs in one thread, so that the same input gives the same bits.
"""

from __future__ import annotations

import numba
import numpy as np


@numba.njit(cache=True, fastmath=True, nogil=True)
def add_blocks(  # type: ignore[no-untyped-def]  # pragma: no cover
    blocks, parents, rotations, beta, twists, positions, derivative
):
    """Add the blocks of every sample to its position and derivative.

    Args:
        blocks: (n, 2) first and last + 1 of each sample's blocks; (m,) the part of a block; (m, 3)
            float32, B_p of the mean; (m, 3, B) float32, B_p of the components; then (n, 2), (k,),
            (k,), (k, 3, 3), the same for the relative twist of one joint.
        parents: (L,).
        rotations: (L, 3, 3) float32.
        beta: (B',) float32, at least as many as there are shape derivatives.
        twists: (L, 3) float32, relative.
        positions: (n, 3) float64, in and out.
        derivative: (n, 3, 3 L + shapes + 3) float32, in and out.
    """
    starts, parts, mean, shape, twist_starts, twist_parts, twist_joints, twist_blocks = blocks
    count = len(starts)
    first = 3 * len(rotations)
    shapes = derivative.shape[2] - first - 3
    for v in range(count):
        out0, out1, out2 = derivative[v, 0], derivative[v, 1], derivative[v, 2]
        field0, field1, field2 = out0[first:], out1[first:], out2[first:]
        for block in range(starts[v, 0], starts[v, 1]):
            part = parts[block]
            turn = rotations[part]
            r00, r01, r02 = turn[0, 0], turn[0, 1], turn[0, 2]
            r10, r11, r12 = turn[1, 0], turn[1, 1], turn[1, 2]
            r20, r21, r22 = turn[2, 0], turn[2, 1], turn[2, 2]
            row0, row1, row2 = shape[block, 0], shape[block, 1], shape[block, 2]
            x, y, z = mean[block, 0], mean[block, 1], mean[block, 2]
            for j in range(shapes):
                a, b, c = row0[j], row1[j], row2[j]
                x += a * beta[j]
                y += b * beta[j]
                z += c * beta[j]
                field0[j] += r00 * a + r01 * b + r02 * c
                field1[j] += r10 * a + r11 * b + r12 * c
                field2[j] += r20 * a + r21 * b + r22 * c
            rest0, rest1, rest2, rest = row0[shapes:], row1[shapes:], row2[shapes:], beta[shapes:]
            for j in range(len(rest)):
                x += rest0[j] * rest[j]
                y += rest1[j] * rest[j]
                z += rest2[j] * rest[j]
            _turn(positions[v], derivative[v], part, turn, x, y, z)
        for block in range(twist_starts[v, 0], twist_starts[v, 1]):
            part, joint = twist_parts[block], twist_joints[block]
            turn, field = rotations[part], twist_blocks[block]
            x, y, z = np.float32(0.0), np.float32(0.0), np.float32(0.0)
            for j in range(3):
                x += field[0, j] * twists[joint, j]
                y += field[1, j] * twists[joint, j]
                z += field[2, j] * twists[joint, j]
            _turn(positions[v], derivative[v], part, turn, x, y, z)
            parent = parents[joint]
            _follow_twist(derivative[v], joint, parent, turn, rotations[parent], field)


@numba.njit(cache=True, fastmath=True, inline="always")
def _turn(position, derivative, part, turn, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add a part's rotated vector (x, y, z) to a position, and its derivative by the rotation."""
    a = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
    b = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
    c = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z
    position[0] += a
    position[1] += b
    position[2] += c
    column = 3 * part
    derivative[0, column + 1] += c
    derivative[0, column + 2] -= b
    derivative[1, column] -= c
    derivative[1, column + 2] += a
    derivative[2, column] += b
    derivative[2, column + 1] -= a


@numba.njit(cache=True, fastmath=True, inline="always")
def _follow_twist(derivative, joint, parent, turn, back, field):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add the derivative of a part's field (3, 3) by a joint's relative twist, which changes by
    back^T (turn of the joint's part - turn of its parent)."""
    for i in range(3):
        a = turn[i, 0] * field[0, 0] + turn[i, 1] * field[1, 0] + turn[i, 2] * field[2, 0]
        b = turn[i, 0] * field[0, 1] + turn[i, 1] * field[1, 1] + turn[i, 2] * field[2, 1]
        c = turn[i, 0] * field[0, 2] + turn[i, 1] * field[1, 2] + turn[i, 2] * field[2, 2]
        for j in range(3):
            change = a * back[j, 0] + b * back[j, 1] + c * back[j, 2]
            derivative[i, 3 * joint + j] += change
            derivative[i, 3 * parent + j] -= change


@numba.njit(cache=True, fastmath=True, nogil=True)
def trimmed_costs(tried, cloud, cloud_cut, tried_cut, tried_share):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Two-way distances (h,) of h sets of points to a cloud.

    Mean distance of the cloud's points to the nearest one of the set, each at most cloud_cut, plus
    tried_share times the mean distance of the set's points to the cloud, each at most tried_cut.

    Args:
        tried: (h, k, n) float32: k coordinates of n points, k a multiple of 3.
        cloud: (m, k) float32.
    """
    tries, size, count = tried.shape
    result = np.empty(tries)
    square, back = np.empty((2, count), np.float32)
    # Positive floats compare like the integers of their bits, which have a vectorised minimum.
    square_bits, back_bits = square.view(np.int32), back.view(np.int32)
    for h in range(tries):
        back[:] = np.float32(np.inf)
        total = 0.0
        for p in range(len(cloud)):
            # Three coordinates at a time: one vectorised pass over memory.
            for k in range(0, size, 3):
                here0, here1, here2 = cloud[p, k], cloud[p, k + 1], cloud[p, k + 2]
                row0, row1, row2 = tried[h, k], tried[h, k + 1], tried[h, k + 2]
                for s in range(count):
                    x, y, z = row0[s] - here0, row1[s] - here1, row2[s] - here2
                    before = square[s] if k > 0 else np.float32(0.0)
                    square[s] = before + x * x + y * y + z * z
            least = square_bits[0]
            for s in range(count):
                least = min(least, square_bits[s])
                back_bits[s] = min(back_bits[s], square_bits[s])
            total += min(np.sqrt(np.int32(least).view(np.float32)), cloud_cut)
        other = 0.0
        for s in range(count):
            other += min(np.sqrt(back[s]), tried_cut)
        result[h] = total / len(cloud) + tried_share * other / count
    return result


@numba.njit(cache=True, nogil=True)
def area_vectors(vertices, faces):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Normals (K, 3) of triangles, of twice their areas' length."""
    out = np.empty((len(faces), 3))
    for k in range(len(faces)):
        a, b, c = faces[k, 0], faces[k, 1], faces[k, 2]
        x1, y1, z1 = (
            vertices[b, 0] - vertices[a, 0],
            vertices[b, 1] - vertices[a, 1],
            vertices[b, 2] - vertices[a, 2],
        )
        x2, y2, z2 = (
            vertices[c, 0] - vertices[a, 0],
            vertices[c, 1] - vertices[a, 1],
            vertices[c, 2] - vertices[a, 2],
        )
        out[k, 0] = y1 * z2 - z1 * y2
        out[k, 1] = z1 * x2 - x1 * z2
        out[k, 2] = x1 * y2 - y1 * x2
    return out


@numba.njit(cache=True, nogil=True)
def summed_at_corners(values, faces, count):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Sums (count, 3) at the vertices of the values (K, 3) of the triangles around them."""
    out = np.zeros((count, 3))
    for k in range(len(faces)):
        for corner in range(3):
            vertex = faces[k, corner]
            for i in range(3):
                out[vertex, i] += values[k, i]
    return out


@numba.njit(cache=True, nogil=True)
def edge_sums(vertices, faces, matrices, weights):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Sums (P, 3) at the vertices of the edges that end there minus those that start there.

    The edges of each triangle are multiplied by its matrix (K, 3, 3) and weight (K,).
    """
    out = np.zeros(vertices.shape)
    for k in range(len(faces)):
        matrix, weight = matrices[k], weights[k]
        for corner in range(3):
            tail, head = faces[k, corner], faces[k, (corner + 1) % 3]
            x = vertices[head, 0] - vertices[tail, 0]
            y = vertices[head, 1] - vertices[tail, 1]
            z = vertices[head, 2] - vertices[tail, 2]
            for i in range(3):
                edge = weight * (matrix[i, 0] * x + matrix[i, 1] * y + matrix[i, 2] * z)
                out[head, i] += edge
                out[tail, i] -= edge
    return out


@numba.njit(cache=True, nogil=True)
def side_by_side(points, directions, scale):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Points (n, 3) and scaled directions (n, 3) in one array (n, 6)."""
    out = np.empty((len(points), 6))
    for p in range(len(points)):
        for i in range(3):
            out[p, i] = points[p, i]
            out[p, 3 + i] = scale * directions[p, i]
    return out


@numba.njit(cache=True, nogil=True)
def interpolated(values, corners, triangle, weights):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Values (P, k) at the corners (K, 3) of triangles (n,), with weights (n, 3) to (n, k)."""
    out = np.empty((len(triangle), values.shape[1]))
    for p in range(len(triangle)):
        a, b, c = corners[triangle[p], 0], corners[triangle[p], 1], corners[triangle[p], 2]
        for i in range(values.shape[1]):
            out[p, i] = (
                weights[p, 0] * values[a, i]
                + weights[p, 1] * values[b, i]
                + weights[p, 2] * values[c, i]
            )
    return out


@numba.njit(cache=True, nogil=True)
def descend(points, nodes, first, neighbours, start, square, product):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Descend for each point to a node of a graph that is nearer than all its neighbours.

    Returns the nodes (m,) and whether they are within the limits (m,).

    Args:
        points: (m, 6): position and scaled direction.
        nodes: (n, 6).
        first: (n + 1,): where each node's neighbours begin.
        neighbours: (e,).
        start: (m,): node that each point starts from; -1 for points that have none.
        square: largest squared distance of positions within the limits.
        product: smallest scalar product of directions within the limits.
    """
    out = np.full(len(points), -1, np.int64)
    within = np.zeros(len(points), np.bool_)
    for p in range(len(points)):
        here = start[p]
        if here < 0:
            continue
        least = 0.0
        for k in range(6):
            least += (points[p, k] - nodes[here, k]) ** 2
        improved = True
        while improved:
            improved = False
            origin = here
            for index in range(first[origin], first[origin + 1]):
                there = neighbours[index]
                distance = 0.0
                for k in range(6):
                    distance += (points[p, k] - nodes[there, k]) ** 2
                if distance < least:
                    least, here, improved = distance, there, True
        apart, along = 0.0, 0.0
        for k in range(3):
            apart += (points[p, k] - nodes[here, k]) ** 2
            along += points[p, 3 + k] * nodes[here, 3 + k]
        out[p], within[p] = here, apart < square and along > product
    return out, within


@numba.njit(cache=True, fastmath=True, nogil=True)
def add_places(blocks, rotations, beta, twists, positions):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add only the positions that `add_blocks` adds."""
    starts, parts, mean, shape, twist_starts, twist_parts, twist_joints, twist_blocks = blocks
    for v in range(len(starts)):
        for block in range(starts[v, 0], starts[v, 1]):
            part = parts[block]
            x, y, z = mean[block, 0], mean[block, 1], mean[block, 2]
            row0, row1, row2 = shape[block, 0], shape[block, 1], shape[block, 2]
            for j in range(len(beta)):
                x += row0[j] * beta[j]
                y += row1[j] * beta[j]
                z += row2[j] * beta[j]
            _place(positions[v], rotations[part], x, y, z)
        for block in range(twist_starts[v, 0], twist_starts[v, 1]):
            twist, field = twists[twist_joints[block]], twist_blocks[block]
            x = field[0, 0] * twist[0] + field[0, 1] * twist[1] + field[0, 2] * twist[2]
            y = field[1, 0] * twist[0] + field[1, 1] * twist[1] + field[1, 2] * twist[2]
            z = field[2, 0] * twist[0] + field[2, 1] * twist[1] + field[2, 2] * twist[2]
            _place(positions[v], rotations[twist_parts[block]], x, y, z)


@numba.njit(cache=True, fastmath=True, inline="always")
def _place(position, turn, x, y, z):  # type: ignore[no-untyped-def]  # pragma: no cover
    position[0] += turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z
    position[1] += turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z
    position[2] += turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z


@numba.njit(cache=True, nogil=True)
def transform_groups(points, group, turns, shifts):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Points (n, 3) rotated by matrices (g, 3, 3) and shifted by vectors (g, 3) of their groups."""
    out = np.empty_like(points)
    for p in range(len(points)):
        turn, shift = turns[group[p]], shifts[group[p]]
        x, y, z = points[p, 0], points[p, 1], points[p, 2]
        for i in range(3):
            out[p, i] = turn[i, 0] * x + turn[i, 1] * y + turn[i, 2] * z + shift[i]
    return out
