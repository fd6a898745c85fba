// Traces a NanoVDB grid of floats with NanoVDB's own HDDA and accessor, along the rays that volpack traces.
//
//     nanovdb_trace GRID.nvdb fog|level WIDTH HEIGHT REPEATS PICTURE < rays
//
// `rays` is numbers: origin, the middle ray, and from there to the right edge and to the top (three each, in
// index space, a voxel being the cube from its coordinate to the next). PICTURE gets one f32 a pixel, in voxels:
// the integral of density over the ray, or the distance to the first zero of a level set, -1 without one.
// Standard output gets the milliseconds of each frame.

#include <nanovdb/util/HDDA.h>
#include <nanovdb/util/IO.h>
#include <nanovdb/util/Ray.h>

#include <cstdio>
#include <cstdlib>
#include <fstream>
#include <iostream>
#include <string>
#include <vector>

using nanovdb::Coord;
using Grid = nanovdb::NanoGrid<float>;
using Ray = nanovdb::Ray<float>;
using Vec = nanovdb::Vec3<float>;

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
__device__ float fog(const Grid& grid, Ray ray)
{
    auto accessor = grid.tree().getAccessor();
    if (!ray.clip(accessor.root().bbox()))
        return 0;
    Coord ijk = nanovdb::RoundDown<Coord>(ray(ray.t0() + 1e-4f));
    nanovdb::HDDA<Ray, Coord> hdda(ray, accessor.getDim(ijk, ray));
    float depth = 0;
    bool inside = true;
    while (inside) {
        const float start = hdda.time(), end = hdda.next();
        if (hdda.dim() == 1 && accessor.isActive(ijk))
            depth += accessor.getValue(ijk) * (end - start);
        inside = hdda.step();
        ijk = nanovdb::RoundDown<Coord>(ray(hdda.time() + 1e-3f));
        hdda.update(ray, accessor.getDim(ijk, ray));
    }
    return depth;
}

// Where NanoVDB's own function sees the sign change. (Any arithmetic on t here makes nvcc 13's code for
// it 1.6 times slower: units are the caller's business.)
__device__ float level(const Grid& grid, Ray ray)
{
    auto accessor = grid.tree().getAccessor();
    Coord ijk;
    float value, t = 0;
    return nanovdb::ZeroCrossing(ray, accessor, ijk, value, t) ? t : -1;
}

template <bool FOG>
__global__ void trace(const Grid* grid, View view, float* picture)
{
    const int x = blockIdx.x * blockDim.x + threadIdx.x, y = blockIdx.y * blockDim.y + threadIdx.y;
    if (x >= view.width || y >= view.height)
        return;
    const Ray ray = ray_of(view, x, y);
    picture[y * view.width + x] = FOG ? fog(*grid, ray) : level(*grid, ray);
}

int main(int count, char** arguments)
{
    if (count != 7)
        return 2;
    View view;
    for (Vec* vector : { &view.origin, &view.forward, &view.right, &view.up })
        if (!(std::cin >> (*vector)[0] >> (*vector)[1] >> (*vector)[2]))
            return 2;
    const bool is_fog = std::string(arguments[2]) == "fog";
    view.width = std::atoi(arguments[3]);
    view.height = std::atoi(arguments[4]);
    const int repeats = std::atoi(arguments[5]);

    auto handle = nanovdb::io::readGrid(arguments[1]);
    if (!handle.grid<float>())
        return 2;
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
    const dim3 block(8, 8), blocks((view.width + 7) / 8, (view.height + 7) / 8);
    for (int i = 0; i < repeats; i++) {
        check(cudaEventRecord(start));
        if (is_fog)
            trace<true><<<blocks, block>>>(static_cast<Grid*>(grid), view, pixels);
        else
            trace<false><<<blocks, block>>>(static_cast<Grid*>(grid), view, pixels);
        check(cudaEventRecord(end));
        check(cudaEventSynchronize(end));
        float milliseconds;
        check(cudaEventElapsedTime(&milliseconds, start, end));
        std::printf("%.6f\n", milliseconds);
    }
    check(cudaMemcpy(picture.data(), pixels, bytes, cudaMemcpyDeviceToHost));
    std::ofstream(arguments[6], std::ios::binary).write(reinterpret_cast<char*>(picture.data()), bytes);
}
