// Reads .vdb files with OpenVDB itself and prints how long it took, as one line of JSON.
//   read_openvdb [-n REPEATS] [-g GRID] FILE...
// Delayed loading is off: every voxel is read. The time covers opening and reading, file by file;
// counting the voxels and freeing a file's grids lie outside it.
//
// g++ -O2 -std=c++17 read_openvdb.cpp -o read_openvdb -lopenvdb -ltbb -lImath-3_1
// (Debian 12: libopenvdb-dev libboost-dev libtbb-dev libimath-dev)

#include <openvdb/openvdb.h>

#include <sys/resource.h>
#include <unistd.h>

#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <vector>

int main(int argc, char** argv)
{
    int repeats = 1;
    std::string name;
    for (int opt; (opt = getopt(argc, argv, "n:g:")) != -1;) {
        if (opt == 'n') repeats = std::atoi(optarg);
        else if (opt == 'g') name = optarg;
        else repeats = 0;
    }
    if (repeats < 1 || optind >= argc) {
        std::fprintf(stderr, "usage: read_openvdb [-n REPEATS] [-g GRID] FILE...\n");
        return 2;
    }
    using Clock = std::chrono::steady_clock;
    std::vector<double> seconds(repeats, 0.0);
    unsigned long long voxels = 0;
    try {
        openvdb::initialize();
        for (int round = 0; round < repeats; ++round) {
            for (int i = optind; i < argc; ++i) {
                const auto start = Clock::now();
                openvdb::io::File file(argv[i]);
                file.open(/*delayLoad=*/false);
                openvdb::GridPtrVec grids;
                if (name.empty()) grids = *file.getGrids();
                else grids.push_back(file.readGrid(name));
                seconds[round] += std::chrono::duration<double>(Clock::now() - start).count();
                if (round + 1 == repeats)
                    for (const auto& grid : grids) voxels += grid->activeVoxelCount();
            }
        }
    } catch (const std::exception& e) {
        std::fprintf(stderr, "read_openvdb: %s\n", e.what());
        return 1;
    }
    struct rusage usage;
    getrusage(RUSAGE_SELF, &usage);
    std::printf("{\"openvdb\":\"%s\",\"files\":%d,\"voxels\":%llu,\"seconds\":[",
        openvdb::getLibraryVersionString(), argc - optind, voxels);
    for (int i = 0; i < repeats; ++i) std::printf("%s%.6f", i ? "," : "", seconds[i]);
    std::printf("],\"peak_rss_kib\":%ld}\n", usage.ru_maxrss);
}
