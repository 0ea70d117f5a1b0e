// Questions about points and labels in space: the label of the nearest point of every voxel, the
// two largest of many fields at a place, sums over boxes of voxels, noise between the nodes of
// lattices. Their use and every formula: gsfluent/pipeline/partition.
//
// Each number is rounded where torch, asked one operation at a time, rounds it, so that both back
// ends give the same labels. Floats go through `product` and `sum`: compilers fuse them otherwise.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/vec.h"

namespace gsf {

#ifdef __CUDA_ARCH__
GSF_INLINE float product(float a, float b) { return __fmul_rn(a, b); }
GSF_INLINE double product(double a, double b) { return __dmul_rn(a, b); }
#else
// What goes through memory, or seems to, is rounded there.
template <typename T>
GSF_INLINE T product(T a, T b) {
  T value = a * b;
#if defined(__x86_64__)
  asm("" : "+x"(value));
#else
  volatile T held = value;
  value = held;
#endif
  return value;
}
#endif

// --- labels of voxels ---

constexpr int kRankBits = 16;  // of a key that hold a label
constexpr int64_t kNoKey = (int64_t(1) << 62) - 1;
constexpr double kFineSquares = 1024.0;  // squared distances are whole numbers of this share

struct NearestLabelsArgs {
  int64_t count;        // P
  const double* place;  // [P, 3] in voxels, centres at whole numbers
  const int64_t* rank;  // [P]
  int64_t shape[3];
  int64_t limit;    // of a squared distance, in shares
  int reach;        // voxels that a point sees along an axis
  int64_t* best;    // [X, Y, Z] keys
  int16_t* labels;  // [X, Y, Z]

  GSF_HOST_DEVICE int64_t voxels() const { return shape[0] * shape[1] * shape[2]; }
  GSF_HOST_DEVICE int64_t square(double apart) const {
    return int64_t(rint(product(product(apart, apart), kFineSquares)));
  }
  GSF_HOST_DEVICE int16_t label(int64_t voxel) const {
    const int64_t key = best[voxel];
    return key < kNoKey ? int16_t(key & ((int64_t(1) << kRankBits) - 1)) : int16_t(-1);
  }
};

// Calls see(voxel, key) for every voxel with first index in [begin, end) that point i can name.
template <typename See>
GSF_INLINE void named_voxels(const NearestLabelsArgs& a, int64_t i, int64_t begin, int64_t end,
                             const See& see) {
  const double* place = a.place + 3 * i;
  int64_t middle[3];
  for (int axis = 0; axis < 3; ++axis) {
    // also false for NaN
    if (!(place[axis] > -1e9 && place[axis] < 1e9)) return;
    middle[axis] = int64_t(rint(place[axis]));
  }
  const int r = a.reach;
  for (int64_t x = middle[0] - r; x <= middle[0] + r; ++x) {
    if (x < begin || x >= end) continue;
    const int64_t along_x = a.square(double(x) - place[0]);
    if (along_x > a.limit) continue;
    for (int64_t y = middle[1] - r; y <= middle[1] + r; ++y) {
      if (y < 0 || y >= a.shape[1]) continue;
      const int64_t line = along_x + a.square(double(y) - place[1]);
      if (line > a.limit) continue;
      for (int64_t z = middle[2] - r; z <= middle[2] + r; ++z) {
        if (z < 0 || z >= a.shape[2]) continue;
        const int64_t total = line + a.square(double(z) - place[2]);
        if (total <= a.limit)
          see((x * a.shape[1] + y) * a.shape[2] + z, (total << kRankBits) + a.rank[i]);
      }
    }
  }
}

// --- the two largest of many fields ---

struct LargestSharesArgs {
  int64_t count;        // M
  const float* place;   // [M, 3] in voxels; null: every voxel of `shape`
  int64_t shape[3];     // of the grid, where there are no places
  int64_t fields;       // F
  const float* shares;  // of all fields, one after the other
  const int64_t* box;   // [F, 7]: first voxel, size, where its shares begin; size 0 for none
  int64_t total;        // shares in all
  int16_t *first, *second;
  float* lead;

  // Whether the shares of a box are there.
  GSF_HOST_DEVICE bool holds(const int64_t* box) const {
    constexpr int64_t kMost = int64_t(1) << 20;
    for (int axis = 3; axis < 6; ++axis)
      if (box[axis] < 1 || box[axis] > kMost) return false;
    return box[6] >= 0 && box[6] <= total && box[3] * box[4] * box[5] <= total - box[6];
  }
};

struct TwoLargest {
  int16_t first = -1, second = -1;
  float one = 0.0f, two = 0.0f;
  GSF_HOST_DEVICE void take(int16_t label, float value) {
    if (value > one) {
      second = first;
      two = one;
      first = label;
      one = value;
    } else if (value > two) {
      second = label;
      two = value;
    }
  }
};

// A field between its voxels, trilinear, 0 outside of its box.
GSF_INLINE float share_between(const float* share, const int64_t* size, const float* local) {
  int64_t low[3];
  float ends[3][2];
  for (int axis = 0; axis < 3; ++axis) {
    const float base = floorf(local[axis]), fraction = local[axis] - base;
    low[axis] = int64_t(base);
    ends[axis][0] = low[axis] >= 0 && low[axis] < size[axis] ? 1.0f - fraction : 0.0f;
    ends[axis][1] = low[axis] + 1 >= 0 && low[axis] + 1 < size[axis] ? fraction : 0.0f;
  }
  float total = 0.0f;
  for (int corner = 0; corner < 8; ++corner) {
    const int side[3] = {corner >> 2, corner >> 1 & 1, corner & 1};
    int64_t at = 0;
    for (int axis = 0; axis < 3; ++axis) {
      const int64_t index = low[axis] + side[axis], most = size[axis] - 1;
      at = at * size[axis] + (index < 0 ? 0 : index > most ? most : index);
    }
    const float weight = product(product(ends[0][side[0]], ends[1][side[1]]), ends[2][side[2]]);
    total = total + product(weight, share[at]);
  }
  return total;
}

// Where place i is: of the list, or of the grid.
GSF_INLINE void place_of(const LargestSharesArgs& a, int64_t i, float* place) {
  if (a.place) {
    for (int axis = 0; axis < 3; ++axis) place[axis] = a.place[3 * i + axis];
    return;
  }
  const int64_t plane = a.shape[1] * a.shape[2];
  place[0] = float(i / plane);
  place[1] = float(i % plane / a.shape[2]);
  place[2] = float(i % a.shape[2]);
}

// Whether a field may be there somewhere between two corners. No for NaN.
GSF_INLINE bool meets(const LargestSharesArgs& a, int64_t label, const float* low,
                      const float* high) {
  const int64_t *first = a.box + 7 * label, *size = first + 3;
  for (int axis = 0; axis < 3; ++axis)
    if (!(high[axis] > float(first[axis] - 1) && low[axis] < float(first[axis] + size[axis])))
      return false;
  return a.holds(first);
}

// Shows a field to a place that it meets.
GSF_INLINE void show(const LargestSharesArgs& a, int64_t label, const float* place,
                     TwoLargest* found) {
  const int64_t *low = a.box + 7 * label, *size = low + 3;
  const float* share = a.shares + low[6];
  float local[3];
  int64_t at = 0;
  bool inside = true;
  for (int axis = 0; axis < 3; ++axis) {
    local[axis] = place[axis] - float(low[axis]);
    const int64_t near = int64_t(rintf(local[axis])), most = size[axis] - 1;
    inside = inside && near >= 0 && near <= most;
    at = at * size[axis] + (near < 0 ? 0 : near > most ? most : near);
  }
  if (!a.place) {
    if (inside) found->take(int16_t(label), share[at]);
  } else if (share[at] > 0.0f) {  // far from the label its share is nothing
    found->take(int16_t(label), share_between(share, size, local));
  }
}

GSF_INLINE void settle(const LargestSharesArgs& a, int64_t i, const TwoLargest& found) {
  a.first[i] = found.first;
  a.second[i] = found.second;
  a.lead[i] = found.one - found.two;
}

// --- sums over boxes of voxels ---

struct BoxSumArgs {
  int64_t shape[3];
  int half;  // voxels to each side
  int axis;
  const int32_t* in;
  int32_t* out;

  GSF_HOST_DEVICE int64_t voxels() const { return shape[0] * shape[1] * shape[2]; }
  // Of the voxels within the grid; whole numbers, which no order changes.
  GSF_HOST_DEVICE int32_t sum(int64_t voxel) const {
    const int64_t stride = axis == 2 ? 1 : axis == 1 ? shape[2] : shape[1] * shape[2];
    const int64_t at = voxel / stride % shape[axis];
    const int64_t first = at < half ? -at : -half;
    const int64_t last = at + half < shape[axis] ? half : shape[axis] - 1 - at;
    int32_t total = 0;
    for (int64_t k = first; k <= last; ++k) total += in[voxel + k * stride];
    return total;
  }
};

// --- between the values of a grid ---

template <typename T>
struct TrilinearArgs {
  int64_t count;  // N
  int64_t shape[3];
  const T* grid;   // [X, Y, Z]
  const T* place;  // [N, 3] in steps
  T* value;        // [N]
};

// The value at a place [steps]; corners outside of the grid have no share.
template <typename T>
GSF_INLINE T trilinear_at(const int64_t* shape, const T* grid, const T* place) {
  int64_t corner[3][2];
  T share[3][2];
  for (int axis = 0; axis < 3; ++axis) {
    // also false for NaN; what is so far out has no neighbours in the grid
    if (!(place[axis] > T(-1e9) && place[axis] < T(1e9))) return place[axis] - place[axis];
    const T base = floor(place[axis]), fraction = place[axis] - base;
    for (int end = 0; end < 2; ++end) {
      corner[axis][end] = int64_t(base) + end;
      const bool held = corner[axis][end] >= 0 && corner[axis][end] < shape[axis];
      share[axis][end] = held ? (end ? fraction : T(1) - fraction) : T(0);
    }
  }
  T total = T(0);
  for (int k = 0; k < 8; ++k) {
    const int x = k >> 2, y = k >> 1 & 1, z = k & 1;
    const T part = product(product(share[0][x], share[1][y]), share[2][z]);
    if (part == T(0)) continue;
    const int64_t at = (corner[0][x] * shape[1] + corner[1][y]) * shape[2] + corner[2][z];
    total += product(part, grid[at]);
  }
  return total;
}

template <typename T>
GSF_INLINE void trilinear(const TrilinearArgs<T>& a, int64_t i) {
  a.value[i] = trilinear_at(a.shape, a.grid, a.place + 3 * i);
}

// --- value noise ---

constexpr int kMostOctaves = 16;

struct ValueNoiseArgs {
  int64_t count;         // M
  const int64_t* voxel;  // [M, 3]
  int octaves;
  double spacing[kMostOctaves];  // of the lattice's nodes [voxels]
  double shift[kMostOctaves];    // of the lattice [spacings]
  float weight[kMostOctaves];
  float* noise;  // [M, 3]
};

// Three uniform values in -1 to 1 at a node of the lattice of an octave.
GSF_INLINE void node_values(const int64_t* node, int octave, float* value) {
  uint32_t h = (uint32_t(node[0]) * 0x8DA6B343u) ^ (uint32_t(node[1]) * 0xD8163841u) ^
               (uint32_t(node[2]) * 0xCB1AB31Fu);
  h ^= uint32_t(octave) * 0x9E3779B1u + 0x2545F491u;
  constexpr uint32_t kTurns[3] = {0x7FEB352Du, 0x846CA68Bu, 0x9E3779B1u};
  for (int axis = 0; axis < 3; ++axis) {
    h = (h ^ (h >> 16)) * kTurns[axis];
    h = (h ^ (h >> 15)) * 0x2C1B3C6Du;
    value[axis] = float(double(h ^ (h >> 16)) * (2.0 / 4294967296.0) - 1.0);
  }
}

GSF_INLINE void value_noise(const ValueNoiseArgs& a, int64_t i) {
  float total[3] = {0.0f, 0.0f, 0.0f};
  for (int octave = 0; octave < a.octaves; ++octave) {
    int64_t base[3];
    float share[3];
    for (int axis = 0; axis < 3; ++axis) {
      const double place = double(a.voxel[3 * i + axis]) / a.spacing[octave] + a.shift[octave];
      const double low = floor(place);
      const float t = float(place - low);
      // what is nowhere has the noise of some node
      base[axis] = low > -1e15 && low < 1e15 ? int64_t(low) : 0;
      share[axis] = product(product(t, t), 3.0f - product(2.0f, t));
    }
    float corner[8][3];
    for (int k = 0; k < 8; ++k) {
      const int64_t node[3] = {base[0] + (k >> 2), base[1] + (k >> 1 & 1), base[2] + (k & 1)};
      node_values(node, octave, corner[k]);
    }
    for (int c = 0; c < 3; ++c) {
      float along[4], across[2];
      for (int k = 0; k < 4; ++k)
        along[k] = corner[k][c] + product(share[0], corner[k + 4][c] - corner[k][c]);
      for (int k = 0; k < 2; ++k) across[k] = along[k] + product(share[1], along[k + 2] - along[k]);
      const float value = across[0] + product(share[2], across[1] - across[0]);
      total[c] += product(value, a.weight[octave]);
    }
  }
  for (int c = 0; c < 3; ++c) a.noise[3 * i + c] = total[c];
}

}  // namespace gsf
