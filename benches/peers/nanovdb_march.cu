// Marches through a NanoVDB grid of floats with NanoVDB's trilinear sampler and accessor, along the rays of `xtask bench layouts`.
//
//     nanovdb_march GRID.nvdb all|skip WIDTH HEIGHT PICTURE
//
// `all` samples at each step, `skip` leaves nodes of one value in one step. Standard input has the view first, in index space: origin,
// the middle ray, from there to the right edge and to the top, the smallest and the largest corner of the box that is sampled (three
// numbers each), and the step in voxels. Then each number is how many frames to make: standard output gets the milliseconds of each, a
// line each. At the end of the input, PICTURE gets the sums of samples times the step, one f32 a pixel. Without arguments it prints
// NanoVDB's version.

#if __has_include(<nanovdb/math/SampleFromVoxels.h>) // from 32.7 on
#include <nanovdb/io/IO.h>
#include <nanovdb/math/Ray.h>
#include <nanovdb/math/SampleFromVoxels.h>
namespace math = nanovdb::math;
#else
#include <nanovdb/util/IO.h>
#include <nanovdb/util/Ray.h>
#include <nanovdb/util/SampleFromVoxels.h>
namespace math = nanovdb;
#endif

#include <cmath>
#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

using math::Coord;
using Grid = nanovdb::NanoGrid<float>;
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
    Vec origin, forward, right, up, low, high;
    float step;
    int width, height;
};

// The places of a pixel's samples: first + k * step, k from 0 to count.
struct Samples
{
    Vec first, step;
    int count;

    __device__ Samples(const View& view, int x, int y)
    {
        const float u = (2 * x + 1) / float(view.width) - 1, v = 1 - (2 * y + 1) / float(view.height);
        Vec d = view.forward + view.right * u + view.up * v;
        d.normalize();
        float start = 0, end = 1e30f;
        for (int i = 0; i < 3; i++) {
            if (fabsf(d[i]) < 1e-9f)
                d[i] = 1e-9f;
            const float a = (view.low[i] - view.origin[i]) / d[i], b = (view.high[i] - view.origin[i]) / d[i];
            start = fmaxf(start, fminf(a, b));
            end = fminf(end, fmaxf(a, b));
        }
        first = view.origin + d * start;
        step = d * view.step;
        count = end > start ? int(ceilf((end - start) / view.step)) : 0;
    }

    __device__ Vec place(int k) const { return first + step * float(k); }

    // The first sample behind the box that holds sample k; at least the next one.
    __device__ int leave(int k, const Coord& low, int dim) const
    {
        float exit = 1e30f;
        for (int i = 0; i < 3; i++)
            exit = fminf(exit, (float(step[i] > 0 ? low[i] + dim : low[i]) - first[i]) / step[i]);
        return max(k + 1, min(count, int(ceilf(fminf(exit, 1e9f)))));
    }
};

template <bool SKIP>
__global__ void march(const void* data, View view, float* picture)
{
    const int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y;
    if (x >= view.width || y >= view.height)
        return;
    const Samples samples(view, x, y);
    auto accessor = static_cast<const Grid*>(data)->tree().getAccessor();
    auto sampler = math::createSampler<1>(accessor);
    // getDim asks for a ray. It uses it in leaves only, which are never left here.
    const Ray ray(view.origin, samples.step);
    float sum = 0;
    for (int k = 0; k < samples.count;) {
        const Vec p = samples.place(k);
        if (SKIP) {
            const Coord ijk = math::RoundDown<Coord>(p);
            if (!accessor.probeLeaf(ijk)) {
                const int dim = accessor.getDim(ijk, ray);
                const Coord low(ijk[0] & -dim, ijk[1] & -dim, ijk[2] & -dim);
                // Samples behind the last voxel of a node are between it and the next node.
                if (dim > 1 && ijk[0] < low[0] + dim - 1 && ijk[1] < low[1] + dim - 1 && ijk[2] < low[2] + dim - 1) {
                    const int next = samples.leave(k, low, dim - 1);
                    sum += float(next - k) * accessor.getValue(ijk);
                    k = next;
                    continue;
                }
            }
        }
        sum += sampler(p);
        k++;
    }
    picture[y * view.width + x] = sum * view.step;
}

int main(int count, char** arguments)
{
    if (count == 1)
        std::printf("%d.%d.%d\n", NANOVDB_MAJOR_VERSION_NUMBER, NANOVDB_MINOR_VERSION_NUMBER,
            NANOVDB_PATCH_VERSION_NUMBER);
    if (count != 6)
        return count == 1 ? 0 : 2;
    View view;
    for (Vec* vector : { &view.origin, &view.forward, &view.right, &view.up, &view.low, &view.high })
        if (!(std::cin >> (*vector)[0] >> (*vector)[1] >> (*vector)[2]))
            return 2;
    if (!(std::cin >> view.step))
        return 2;
    const bool skips = arguments[2] == std::string("skip");
    view.width = std::atoi(arguments[3]);
    view.height = std::atoi(arguments[4]);

    auto handle = nanovdb::io::readGrid(arguments[1]);
    if (!handle.grid<float>())
        return 2;
    void* grid;
    float* pixels;
    std::vector<float> picture(size_t(view.width) * view.height);
    const size_t bytes = picture.size() * sizeof(float);
    check(cudaMalloc(reinterpret_cast<void**>(&grid), handle.size()));
    check(cudaMemcpy(grid, handle.data(), handle.size(), cudaMemcpyHostToDevice));
    check(cudaMalloc(reinterpret_cast<void**>(&pixels), bytes));

    cudaEvent_t start, end;
    check(cudaEventCreate(&start));
    check(cudaEventCreate(&end));
    const dim3 block(8, 16), blocks((view.width + 7) / 8, (view.height + 15) / 16);
    for (int frames; std::cin >> frames;) {
        for (int i = 0; i < frames; i++) {
            check(cudaEventRecord(start));
            if (skips)
                march<true><<<blocks, block>>>(grid, view, pixels);
            else
                march<false><<<blocks, block>>>(grid, view, pixels);
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
