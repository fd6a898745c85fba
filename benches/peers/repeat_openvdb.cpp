// Makes a long sequence out of a short one: each repeat of it is moved by voxels that are no multiple of a
// brick's 8, and its values are scaled, so that no brick of one repeat is one of another.
// Usage: repeat_openvdb FOLDER REPEATS IN.vdb...
// Writes FOLDER/frame_0001.vdb and so on, as the sources are: float grids, half or not, as compressed.
//
// g++ -O2 -std=c++17 repeat_openvdb.cpp -o repeat_openvdb -lopenvdb -ltbb -lImath-3_1
#include <cstdio>
#include <cstdlib>
#include <iostream>
#include <openvdb/openvdb.h>

static openvdb::FloatGrid::Ptr moved(const openvdb::FloatGrid &in, const openvdb::Coord &shift, float factor) {
    auto out = openvdb::FloatGrid::create(in.background());
    out->insertMeta(in);
    out->setTransform(in.transform().copy());
    auto accessor = out->getAccessor();
    for (auto it = in.cbeginValueOn(); it; ++it) {
        if (it.isVoxelValue()) {
            accessor.setValueOn(it.getCoord() + shift, *it * factor);
        } else {
            auto box = it.getBoundingBox();
            box.translate(shift);
            out->fill(box, *it * factor, true);
        }
    }
    return out;
}

int main(int argc, char **argv) {
    if (argc < 4) {
        std::cerr << "usage: repeat_openvdb FOLDER REPEATS IN.vdb...\n";
        return 2;
    }
    openvdb::initialize();
    const int repeats = std::atoi(argv[2]);
    int number = 0;
    for (int r = 0; r < repeats; ++r) {
        const openvdb::Coord shift(1 + r % 7, 1 + 3 * r % 7, 1 + 5 * r % 7);
        const float factor = 1.0f - 0.013f * static_cast<float>(r);
        for (int i = 3; i < argc; ++i) {
            openvdb::io::File in(argv[i]);
            in.open();
            const auto sources = in.getGrids();
            openvdb::GridPtrVec grids;
            for (auto &base : *sources) {
                if (auto grid = openvdb::gridPtrCast<openvdb::FloatGrid>(base)) {
                    grids.push_back(moved(*grid, shift, factor));
                }
            }
            char name[32];
            std::snprintf(name, sizeof name, "/frame_%04d.vdb", ++number);
            openvdb::io::File out(std::string(argv[1]) + name);
            out.setCompression(in.compression());
            out.write(grids);
        }
    }
}
