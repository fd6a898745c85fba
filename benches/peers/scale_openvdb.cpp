// Scales the values of every float grid of an OpenVDB file: an edited frame.
// Usage: scale_openvdb IN.vdb OUT.vdb FACTOR
#include <cstdlib>
#include <iostream>
#include <openvdb/openvdb.h>
#include <openvdb/tools/ValueTransformer.h>

int main(int argc, char **argv) {
    if (argc != 4) {
        std::cerr << "usage: scale_openvdb IN.vdb OUT.vdb FACTOR\n";
        return 2;
    }
    openvdb::initialize();
    openvdb::io::File in(argv[1]);
    in.open();
    auto grids = in.getGrids();
    const float factor = std::strtof(argv[3], nullptr);
    for (auto &base : *grids) {
        if (auto grid = openvdb::gridPtrCast<openvdb::FloatGrid>(base)) {
            openvdb::tools::foreach (grid->beginValueOn(), [=](const openvdb::FloatGrid::ValueOnIter &it) {
                it.setValue(*it * factor);
            });
        }
    }
    openvdb::io::File out(argv[2]);
    out.write(*grids);
}
