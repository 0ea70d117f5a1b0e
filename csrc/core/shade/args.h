// Arguments of the shading of a picture: plain pointers and sizes, the same for CPU and CUDA. How
// lamps, cameras of shadow maps and studio are packed: gsfluent/pipeline/light/shade.py.
#pragma once

#include "core/vec.h"

namespace gsf {

constexpr int kLampColumns = 12;
constexpr int kMapColumns = 15;
constexpr int kStudioColumns = 13;
constexpr int kCubeFaces = 6;
constexpr int kOcclusionLevels = 5;  // of the pyramid

template <typename T>
struct ShadeArgs {
  int64_t width, height;
  const T* image;        // [H, W, 3] display colours times opacity
  const T* alpha;        // [H, W]
  const T* depth;        // [H, W]
  const T* normal;       // [H, W, vectors]: normal, then, when gloss is null, gloss times opacity
  int vectors;           // 3, or 5
  const T* gloss;        // [2] for all pixels, or null
  const T* viewmat;      // [4, 4]
  const T* intrinsics;   // [3, 3]
  const T* lamps;        // [lamp_count, kLampColumns]
  const T* environment;  // [9, 3]
  const T* background;   // [3], display
  int lamp_count;
  const T* map_depth;    // [maps, texels, texels], or null
  const T* map_alpha;    // [maps, texels, texels]
  const T* map_cameras;  // [maps, kMapColumns]
  int maps, texels;
  const T* occupancy;   // all levels one after the other, or null
  const T* grid_frame;  // [4] corner and finest cell
  int nodes;            // cells along the finest level's side
  T occlusion;          // strength, 0 to 1
  const T* studio;      // [kStudioColumns], or null
  T* out;               // [H, W, 3] display values in [0, 1]
  // [maps, blocks + 1, blocks + 1] blocks of a map with an opaque texel before this line and column
  // (cpu/shade.cpp), or null; CPU only
  const int32_t* blockers = nullptr;
  const T* pairs = nullptr;  // the maps as cpu/shade_taps.h reads them, or null; CPU only
};

}  // namespace gsf
