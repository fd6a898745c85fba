// Traces a NanoVDB grid of floats, or of FpN, with NanoVDB's own HDDA and accessor, along the rays that volpack traces.
//
//     nanovdb_trace GRID.nvdb fog|nearest|trilinear WIDTH HEIGHT PICTURE
//
// Standard input has the rays first: origin, the middle ray, and from there to the right edge and to the top (three
// numbers each, in index space; unless it is trilinear, a voxel is the cube from its coordinate to the next). Then each
// number is how many frames to trace: standard output gets the milliseconds of each, a line each. At the end of the
// input, PICTURE gets one f32 a pixel, in voxels: the integral of density over the ray, or the distance to the first
// zero of a level set, -1 without one: where a voxel's sign is another (nearest), or of the interpolant of eight
// (trilinear). Without arguments it prints NanoVDB's version.

#if __has_include(<nanovdb/math/HDDA.h>) // from 32.7 on
#include <nanovdb/io/IO.h>
#include <nanovdb/math/HDDA.h>
#include <nanovdb/math/Ray.h>
namespace math = nanovdb::math;
#else
#include <nanovdb/util/HDDA.h>
#include <nanovdb/util/IO.h>
#include <nanovdb/util/Ray.h>
namespace math = nanovdb;
#endif

#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

using math::Coord;
template <typename Build>
using Grid = nanovdb::NanoGrid<Build>;
template <typename Build>
using Accessor = nanovdb::DefaultReadAccessor<Build>;
using Ray = math::Ray<float>;
using Vec = math::Vec3<float>;

static void check(cudaError_t error)
{
    if (error != cudaSuccess) {
        std::fprintf(stderr, "%s\n", cudaGetErrorString(error));
        std::exit(1);
    }
}

struct View
{
    Vec origin, forward, right, up;
    int width, height;
};

// A ray whose time counts voxels, as NanoVDB's nudges over edges want it.
__device__ Ray ray_of(const View& view, int x, int y)
{
    const float u = (2 * x + 1) / float(view.width) - 1, v = 1 - (2 * y + 1) / float(view.height);
    Vec direction = view.forward + view.right * u + view.up * v;
    direction.normalize();
    return Ray(view.origin, direction, 0.0f);
}

// The integral of density: every voxel on the ray, with the length of the ray in it.
template <typename Build>
__device__ float fog(const Grid<Build>& grid, Ray ray)
{
    auto accessor = grid.tree().getAccessor();
    if (!ray.clip(accessor.root().bbox()))
        return 0;
    Coord ijk = math::RoundDown<Coord>(ray(ray.t0() + 1e-4f));
    math::HDDA<Ray, Coord> hdda(ray, accessor.getDim(ijk, ray));
    float depth = 0;
    bool inside = true;
    while (inside) {
        const float start = hdda.time(), end = hdda.next();
        if (hdda.dim() == 1 && accessor.isActive(ijk))
            depth += accessor.getValue(ijk) * (end - start);
        inside = hdda.step();
        ijk = math::RoundDown<Coord>(ray(hdda.time() + 1e-3f));
        hdda.update(ray, accessor.getDim(ijk, ray));
    }
    return depth;
}

// Where NanoVDB's own function sees the sign change. (Any arithmetic on t here makes nvcc 13's code for
// it 1.6 times slower: units are the caller's business.)
template <typename Build>
__device__ float nearest(const Grid<Build>& grid, Ray ray)
{
    auto accessor = grid.tree().getAccessor();
    Coord ijk;
    float value, t = 0;
    return math::ZeroCrossing(ray, accessor, ijk, value, t) ? t : -1;
}

// The eight voxels from ijk on, ordered by x + 2y + 4z: straight from a leaf that holds them all.
template <typename Build>
__device__ void corners(Accessor<Build>& accessor, const Coord& ijk, float* v)
{
    const auto* leaf = accessor.probeLeaf(ijk);
    if (leaf && (ijk[0] & 7) < 7 && (ijk[1] & 7) < 7 && (ijk[2] & 7) < 7) {
        const auto first = nanovdb::NanoLeaf<Build>::CoordToOffset(ijk);
#pragma unroll
        for (int i = 0; i < 8; i++)
            v[i] = leaf->data()->getValue(first + (i & 1) * 64 + (i >> 1 & 1) * 8 + (i >> 2));
    } else {
#pragma unroll
        for (int i = 0; i < 8; i++)
            v[i] = accessor.getValue(ijk + Coord(i & 1, i >> 1 & 1, i >> 2));
    }
}

// The interpolant of a cell along a ray, from `p` on by `d`, as a cubic in 0 to 1, lowest power first.
struct Cubic
{
    float c[4];

    Cubic() = default;

    __device__ Cubic(const float* v, const Vec& p, const Vec& d)
    {
        const float x = v[1] - v[0], y = v[2] - v[0], z = v[4] - v[0];
        const float xy = v[3] - v[1] - y, yz = v[6] - v[2] - z, xz = v[5] - v[1] - z;
        const float xyz = v[7] - v[3] - v[5] - v[6] + v[1] + v[2] + z;
        c[0] = v[0] + x * p[0] + y * p[1] + z * p[2] + xy * p[0] * p[1] + yz * p[1] * p[2] + xz * p[0] * p[2]
            + xyz * p[0] * p[1] * p[2];
        c[1] = x * d[0] + y * d[1] + z * d[2] + xy * (p[0] * d[1] + d[0] * p[1]) + yz * (p[1] * d[2] + d[1] * p[2])
            + xz * (p[0] * d[2] + d[0] * p[2])
            + xyz * (p[0] * p[1] * d[2] + p[0] * d[1] * p[2] + d[0] * p[1] * p[2]);
        c[2] = xy * d[0] * d[1] + yz * d[1] * d[2] + xz * d[0] * d[2]
            + xyz * (p[0] * d[1] * d[2] + d[0] * p[1] * d[2] + d[0] * d[1] * p[2]);
        c[3] = xyz * d[0] * d[1] * d[2];
    }

    __device__ bool changed(float u, bool negative) const
    {
        return ((((c[3] * u + c[2]) * u + c[1]) * u + c[0]) < 0) != negative;
    }

    // Between which places its sign first changes: cut where it turns, each piece has at most one root.
    __device__ bool bracket(bool negative, float& low, float& high) const
    {
        low = high = 0;
        if (changed(0, negative))
            return true;
        float first = 0, second = 0;
        const float a = 3 * c[3], discriminant = c[2] * c[2] - a * c[1];
        if (discriminant >= 0) {
            const float root = sqrtf(discriminant), q = c[2] < 0 ? root - c[2] : -(root + c[2]);
            first = a == 0 ? 0 : q / a;
            second = q == 0 ? 0 : c[1] / q;
        }
        for (const float end : { fminf(first, second), fmaxf(first, second), 1.0f }) {
            if (end > low && end <= 1) {
                high = end;
                if (changed(high, negative))
                    return true;
                low = high;
            }
        }
        return false;
    }
};

// The first zero of the trilinear interpolant. As in any narrow band, cells with a zero begin at an active
// voxel. Halving comes after all steps, with the whole warp: that halves the time.
template <typename Build>
__device__ float trilinear(const Grid<Build>& grid, Ray ray)
{
    auto accessor = grid.tree().getAccessor();
    if (!ray.clip(accessor.root().bbox()))
        return -1;
    Coord ijk = math::RoundDown<Coord>(ray(ray.t0() + 1e-3f));
    math::HDDA<Ray, Coord> hdda(ray, accessor.getDim(ijk, ray));
    const bool negative = accessor.getValue(ijk) < 0;
    bool found = false;
    float start = 0, length = 0, low = 0, high = 0;
    Cubic cubic;
    for (bool inside = true; inside && !found;) {
        ijk = math::RoundDown<Coord>(ray(hdda.time() + 1e-3f));
        hdda.update(ray, accessor.getDim(ijk, ray));
        if (hdda.dim() == 1 && accessor.isActive(ijk)) {
            do {
                ijk = hdda.voxel();
                float v[8];
                corners<Build>(accessor, ijk, v);
                bool mixed = false;
#pragma unroll
                for (int i = 0; i < 8; i++)
                    mixed |= (v[i] < 0) != negative;
                if (mixed) {
                    start = hdda.time();
                    length = hdda.next() - start;
                    const Vec from = ray(start) - Vec(float(ijk[0]), float(ijk[1]), float(ijk[2]));
                    cubic = Cubic(v, from, ray.dir() * length);
                    found = cubic.bracket(negative, low, high);
                }
            } while (!found && hdda.step() && accessor.isActive(hdda.voxel()));
        }
        if (!found)
            inside = hdda.step();
    }
    if (!found)
        return -1;
    for (int n = 0; n < 24; n++) {
        const float middle = (low + high) * 0.5f;
        const bool change = cubic.changed(middle, negative);
        high = change ? middle : high;
        low = change ? low : middle;
    }
    return start + length * high;
}

template <typename Build, float TRACE(const Grid<Build>&, Ray)>
__global__ void trace(const void* grid, View view, float* picture)
{
    const int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y;
    if (x >= view.width || y >= view.height)
        return;
    picture[y * view.width + x] = TRACE(*static_cast<const Grid<Build>*>(grid), ray_of(view, x, y));
}

using Kernel = void (*)(const void*, View, float*);

template <typename Build>
Kernel kernel_of(const std::string& shows)
{
    return shows == "fog" ? trace<Build, fog<Build>>
        : shows == "nearest" ? trace<Build, nearest<Build>>
                             : trace<Build, trilinear<Build>>;
}

int main(int count, char** arguments)
{
    if (count == 1)
        std::printf("%d.%d.%d\n", NANOVDB_MAJOR_VERSION_NUMBER, NANOVDB_MINOR_VERSION_NUMBER,
            NANOVDB_PATCH_VERSION_NUMBER);
    if (count != 6)
        return count == 1 ? 0 : 2;
    View view;
    for (Vec* vector : { &view.origin, &view.forward, &view.right, &view.up })
        if (!(std::cin >> (*vector)[0] >> (*vector)[1] >> (*vector)[2]))
            return 2;
    const std::string shows = arguments[2];
    view.width = std::atoi(arguments[3]);
    view.height = std::atoi(arguments[4]);

    auto handle = nanovdb::io::readGrid(arguments[1]);
    if (!handle.grid<float>() && !handle.grid<nanovdb::FpN>())
        return 2;
    const Kernel kernel = handle.grid<float>() ? kernel_of<float>(shows) : kernel_of<nanovdb::FpN>(shows);
    void* grid;
    float* pixels;
    std::vector<float> picture(size_t(view.width) * view.height);
    const size_t bytes = picture.size() * sizeof(float);
    check(cudaMalloc(&grid, handle.size()));
    check(cudaMemcpy(grid, handle.data(), handle.size(), cudaMemcpyHostToDevice));
    check(cudaMalloc(&pixels, bytes));

    cudaEvent_t start, end;
    check(cudaEventCreate(&start));
    check(cudaEventCreate(&end));
    // Trilinear is 4 % faster in blocks of 8 × 16 than of 8 × 8.
    const dim3 block(8, shows == "trilinear" ? 16 : 8);
    const dim3 blocks((view.width + 7) / 8, (view.height + block.y - 1) / block.y);
    for (int frames; std::cin >> frames;) {
        for (int i = 0; i < frames; i++) {
            check(cudaEventRecord(start));
            kernel<<<blocks, block>>>(grid, view, pixels);
            check(cudaEventRecord(end));
            check(cudaEventSynchronize(end));
            float milliseconds;
            check(cudaEventElapsedTime(&milliseconds, start, end));
            std::printf("%.6f\n", milliseconds);
        }
        std::fflush(stdout);
    }
    check(cudaMemcpy(picture.data(), pixels, bytes, cudaMemcpyDeviceToHost));
    std::ofstream(arguments[5], std::ios::binary).write(reinterpret_cast<char*>(picture.data()), bytes);
}
