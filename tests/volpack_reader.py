"""A second reader of .volpack files, written from docs/format.md alone. `volpack_reader.py PACK` prints a line of
JSON for each frame of each grid. Python 3.9; uses zstandard where chunks are compressed, blake3 if it is there."""
import ctypes, importlib.util, itertools, json, math, pathlib, struct, sys, types, zlib

blake3, zstandard = (importlib.util.find_spec(name) and importlib.import_module(name) for name in ("blake3", "zstandard"))
# BC7 is "BPTC" in the Khronos Data Format Specification. A mode's digits: subsets; bits of partition, rotation, index
# selection, colour, alpha; P-bits of an endpoint, of a subset; bits of an index, of a second index.
MODES = "3400401030 2600600130 3600500020 2600701020 1021560023 1020780022 1000771040 2600551020".split()
# By number of subsets: for each partition the subset of each texel, texel 0 lowest, in 16 or 32 bits.
SHAPES = ("", "", "cccc8888eeeeecc8c880feecfec8ec80c800ffecfe80e800ffe8ff00fff0f000f710008e710008ce008c731031008cce088c"
          "31106666366c17e80ff0718e399caaaaf0f05a5a33cc3c3c55aa9696a55a73ce13c8324c3bdc6996c33c99660660027204e44e402720"
          "c936936c39c6639c93369cc6817ee718ccf00fcc7744ee22", "aa6850506a5a50405a5a42005450a0a8a5a50000a0a050505555a0a0"
          "5a5a5050aa550000aa555500aaaa55009090909094949494a4a4a4a4a9a594502a0a4250a59450400a425054a5a5a50055a0a0a0a8a8"
          "54546a6a4040a4a450001a1a05000050a4a4aaa590901469691469691400a08585a0aa82141450a4a4506a5a0200a9a580005090a0a8"
          "a8a090502424242400aa5500249249242449922450a50a50500aa550aaaa444466660000a5a0a5a050a050a06928692844aaaa446666"
          "6600aa44444454a854a89580958096969600a85454a880959580aa14141496960000aaaa1414a05050a0a0a5a5a09600000040804080"
          "a9a8a9a8aaaaaa442a4a5254")
# By number of subsets: for each partition the anchor texels of the second and third subset.
ANCHORS = ((), (), ("fffffffffffffffff282288f28228822ff6828ff28222ff66268ff22fffff22f",), (
    "33ff83ff88666533338f336a588685ff8f356a8ff3f5ffff3f55585a5a8dfc33",
    "f883ff38fffffff8f8f3f8f83f6affa8f3faa89a6f8f3668f3ffffffffff3ff8"))

def check(ok, what):
    if not ok:
        raise ValueError(what)

def fields(number, widths):
    """A number cut into fields of some bits each, lowest first."""
    return [number >> at & (1 << bits) - 1 for at, bits in zip(itertools.accumulate(widths, initial=0), widths)]

def ravel(p, sizes=(8, 8, 8)):
    return (p[0] * sizes[1] + p[1]) * sizes[2] + p[2]

def real(word):
    return struct.unpack("<f", struct.pack("<I", word))[0]

def bc4(block):
    """A block's 16 texels, row by row; the one channel is a numerator over 7 * 255."""
    a, b, *codes = fields(int.from_bytes(block, "little"), [8, 8] + [3] * 16)
    check(a > b or a == b and max(codes) < 6, "a BC4 block has the palette of 6")
    palette = [7 * a, 7 * b] + [(7 - i) * a + i * b for i in range(1, 7)]
    return [(palette[code],) for code in codes]

def bc7(block):
    """A block's 16 texels, row by row; the four channels are bytes."""
    if block[0] == 0:
        return [(0, 0, 0, 0)] * 16
    bits = int.from_bytes(block, "little")
    mode = (bits & -bits).bit_length() - 1
    n, pb, rb, sb, cb, ab, each, shared, ib, ib2 = map(int, MODES[mode])
    part, low = bits >> mode + 1 & (1 << pb) - 1, 2 * n * each + n * shared
    anchors = [0] + [int(anchor[part], 16) for anchor in ANCHORS[n]]
    indices = [ib - (i in anchors) for i in range(16)] + [ib2 - (i == 0) for i in range(16 if ib2 else 0)]
    _, _, rotation, swap, *rest = fields(bits, [mode + 1, pb, rb, sb] + [cb] * 6 * n + [ab] * 2 * n + [1] * low + indices)
    shape = int(SHAPES[n][4 * (n - 1) * part:][:4 * (n - 1)] or "0", 16)
    subsets = [shape >> (n - 1) * i & (0, 0, 1, 3)[n] for i in range(16)]
    colour, alpha = (rest[8 * n + low:][:16], ib), (rest[-16:], ib2 or ib)
    colour, alpha = (alpha, colour) if swap else (colour, alpha)
    channels = []
    for c, (index, count) in enumerate((colour, colour, colour, alpha)):
        ends, width = rest[2 * n * c:][:2 * n], (cb, cb, cb, ab)[c] + (low > 0)
        if low:
            ends = [end << 1 | rest[8 * n + (e >> shared)] for e, end in enumerate(ends)]
        ends = [end << 8 - width | end << 8 - width >> width if c < 3 or ab else 255 for end in ends]
        weights = [(64 * i + (1 << count) // 2 - 1) // ((1 << count) - 1) for i in index]
        channels.append([(64 - w) * ends[2 * s] + w * ends[2 * s + 1] + 32 >> 6 for s, w in zip(subsets, weights)])
    if rotation:
        channels[3], channels[rotation - 1] = channels[rotation - 1], channels[3]
    return list(zip(*channels))

# By tag: rows of a slice, bytes of a row of one brick, slices, what reads a row or block, what 1 is as a texel.
CODECS = {1: (2, 32, 2, bc7, 255), 2: (2, 16, 8, bc4, 7 * 255), 3: (8, 8, 8, "<8B", 255), 4: (8, 16, 8, "<8e", 0),
          5: (8, 32, 8, "<8f", 0)}

class Pack:
    def __init__(self, path):
        self.data = data = pathlib.Path(path).read_bytes()
        check(len(data) >= 64 and data[:8] == b"\x89VOLPK\r\n", "not a .volpack file")
        major, _, sections, chunks, _, size, digest = struct.unpack_from("<HHIIIQ32s", data, 8)
        table, end = 64 + 80 * sections, 64 + 80 * sections + 48 * chunks
        check(major == 0 and end <= size == len(data), "another version, or cut short")
        check(not blake3 or blake3.blake3(data[:32] + bytes(32) + data[64:end]).digest() == digest, "header digest")
        self.chunks, self.cache, self.regions, self.part, texels = {}, {}, {}, {}, {}
        for kind, tag, encoding, _, first, count in struct.iter_unpack("<6I56x", data[64:table]):
            for n in range(first, first + count):
                self.chunks[n] = encoding, *struct.unpack_from("<QII32s", data[:end], table + 48 * n)
            texels.update({tag: first} if kind == 7 else {})
            self.part[kind] = b"".join(self.chunk(n) for n in range(first, first + count) if kind != 7)
        self.tree = [word for word, in struct.iter_unpack("<I", self.part[6])]
        self.atlases = {a[0]: (*a[1:], texels[a[0]]) for a in struct.iter_unpack("<4I8x", self.part[4])}
        numbers, self.grids = [number for number, in struct.iter_unpack("<4xi184x", self.part[2])], []
        for name, length, frame, count in struct.iter_unpack("<II4xII12x", self.part[1]):
            head = struct.unpack_from("<3i6I3fI", self.part[6], 4 * self.tree[2] + 64 * len(self.grids))
            self.grids.append(types.SimpleNamespace(
                name=self.part[3][name:name + length].decode(), frames=numbers[frame:frame + count], origin=head[:3],
                cells=head[3:6], nodes=head[6:9], lo=head[9], span=head[10], background=head[11], roots=head[12]))

    def chunk(self, number):
        if number not in self.cache:
            encoding, at, stored, raw, digest = self.chunks[number]
            data = self.data[at:at + stored]
            check(not blake3 or blake3.blake3(data).digest() == digest, f"digest of chunk {number}")
            if stored != raw:
                check(zstandard, "chunks are compressed: `pip install zstandard`, or build with `--zstd 0`")
                shuffled, size = zstandard.ZstdDecompressor().decompress(data, max_output_size=raw), (0, 1, 2, 4)[encoding]
                data, words = bytearray(shuffled), raw // size
                for i in range(size):
                    data[i:size * words:size] = shuffled[i * words:(i + 1) * words]
            check(len(data) == raw, f"length of chunk {number}")
            self.cache[number] = data
        return self.cache[number]

    def item(self, area, number, words):
        """The word at which an L2 node, L3 record, mask or constant begins."""
        check(number < self.tree[area + 1], f"no item {number} in area {area}")
        return self.tree[area] + number * words

    def constant(self, link):
        place, active, _ = fields(link, (30, 1, 1))
        return real(self.tree[self.item(9, place, 1)]), active

    def mask(self, number):
        at = self.item(7, number, 16)
        return [bit for word in self.tree[at:at + 16] for bit in fields(word, [1] * 32)]

    def children(self, base, bits, only=None):
        """For each child of the node at word `base`, or `only` one: the word behind its ranks, and the child's rank."""
        words = -(-bits // 32)
        for i in range(bits) if only is None else (only,):
            word, rank = self.tree[base + i // 32], self.tree[base + words + i // 64] >> i // 32 % 2 * 16 & 0xFFFF
            if word >> i % 32 & 1:
                yield base + words + -(-words // 2), rank + bin(word & (1 << i % 32) - 1).count("1")

    def walk(self, grid, frame, path=None):
        """(0, constant root), (1, constant cell) and (2, record number), of a whole frame or on one path."""
        count = math.prod(grid.nodes)
        for r in range(count) if path is None else path[:1]:
            root = self.tree[grid.roots + frame * count + r]
            if root >> 31:
                yield 0, root
            for links, rank in self.children(root, math.prod(grid.cells), path and path[1]) if 0 < root < 1 << 31 else ():
                link = self.tree[links + rank]
                if link >> 31:
                    yield 1, link
                    continue
                for first, rank in self.children(self.item(3, link, 193), 4096, path and path[2]):
                    yield 2, self.tree[first] + rank

    def texels(self, grid, tag, axis, slot, scale):
        """The values that a brick's texels give its 512 voxels."""
        (bricks, across, down, first), (rows, size, slices, how, one) = self.atlases[tag], CODECS[tag]
        check(slot < bricks, f"no brick {slot}")
        data, (row, column) = self.chunk(first + slot // (across * down)), divmod(slot % (across * down), across)
        texels, voxels = [], [None] * 512
        for t, r in itertools.product(range(slices), range(rows)):
            at = (((t * down + row) * rows + r) * across + column) * size
            if isinstance(how, str):
                texels += zip(struct.unpack_from(how, data, at))
            else:
                a, b = how(data[at:at + size // 2]), how(data[at + size // 2:at + size])
                texels += [x for i in (0, 4, 8, 12) for x in a[i:i + 4] + b[i:i + 4]]
        for i, texel in enumerate(texels):
            for c, x in enumerate(texel):
                p = [i % 8, i // 8 % 8]
                p.insert(axis, i // 64 * len(texel) + c)
                voxels[ravel(p)] = x
        if not one:
            return voxels
        f32, (least, extent) = lambda x: ctypes.c_float(x).value, struct.unpack("<He", struct.pack("<I", scale))
        values = {k: f32(grid.lo + f32(grid.span * f32(f32(least / 65535) + f32(extent * f32(k / one))))) for k in set(voxels)}
        return [values[k] for k in voxels]

    def region(self, grid, number):
        """The 512 (value, active) of a record."""
        if number not in self.regions:
            at, background = self.item(5, number, 3), grid.background
            (tag, axis, slot), (mask, rule) = fields(self.tree[at], (3, 2, 27)), fields(self.tree[at + 1], (30, 2))
            last = self.tree[at + 2]
            values = self.texels(grid, tag, axis, slot, last) if tag else [real(last)] * 512
            active = self.mask(mask) if mask < 2 ** 30 - 1 else [v != background for v in values]
            if rule < 3:
                minus = self.mask(mask + 1) if rule == 2 else [rule] * 512
                values = [v if a else -background if m else background for v, a, m in zip(values, active, minus)]
            self.regions[number] = list(zip(values, active))
        return self.regions[number]

    def voxel(self, grid_index, frame_index, xyz):
        """The (value, active) of one voxel."""
        grid = self.grids[grid_index]
        at = [p - origin for p, origin in zip(xyz, grid.origin)]
        if any(a < 0 or a >= 128 * c * r for a, c, r in zip(at, grid.cells, grid.nodes)):
            return grid.background, False
        path = (ravel([a // 128 // c for a, c in zip(at, grid.cells)], grid.nodes),
                ravel([a // 128 % c for a, c in zip(at, grid.cells)], grid.cells), ravel([a // 8 % 16 for a in at], [16] * 3))
        for level, what in self.walk(grid, frame_index, path):
            return self.constant(what) if level < 2 else self.region(grid, what)[ravel([p % 8 for p in xyz])]
        return grid.background, False

def main(path):
    pack = Pack(path)
    for grid in pack.grids:
        for f, number in enumerate(grid.frames):
            found, crc = list(pack.walk(grid, f)), 0
            regions = [pack.region(grid, what) for level, what in found if level == 2]
            for region in regions:
                crc = zlib.crc32(struct.pack("<" + "fB" * 512, *itertools.chain(*region)), crc)
            constants = [sum(level == 0 for level, _ in found), sum(level == 1 for level, _ in found)]
            print(json.dumps({"grid": grid.name, "frame": number, "voxels": 512 * len(regions), "active": sum(
                active for region in regions for _, active in region), "crc32": f"{crc:08x}", "constants": constants}))

if __name__ == "__main__":
    try:
        main(sys.argv[1])
    except (ValueError, LookupError, struct.error) as error:
        sys.exit(f"volpack_reader: {error}")
