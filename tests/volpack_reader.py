"""A second reader of .volpack files, written from docs/format.md alone. `volpack_reader.py PACK` prints a line of
JSON for each frame of each grid. `volpack_reader.py PACK EXPECTED` prints what the pack has where EXPECTED, a file of
tests/conformance, asks for it. Python 3.9; zstandard where chunks are compressed, blake3 only if it is there."""
import collections, ctypes, functools, importlib.util, itertools, json, math, pathlib, struct, sys, zlib

blake3, zstd = (importlib.util.find_spec(n) and importlib.import_module(n) for n in ("blake3", "zstandard"))
# BC7 is "BPTC" in the Khronos Data Format Specification. A mode's digits: subsets; bits of partition, rotation, index
# selection, colour, alpha; P-bits of an endpoint, of a subset; bits of an index, of a second index. A partition's:
# texels' subsets, texel 0 lowest, 1 or 2 bits each, then all anchors but the first. 64 of two subsets, 64 of three.
MODES = "3400401030 2600600130 3600500020 2600701020 1021560023 1020780022 1000771040 2600551020".split()
PARTS = ("ccccf8888feeeefecc8fc880ffeecffec8fec80fc800fffecffe80fe800fffe8fff00ffff0ff000ff710f008e27100808ce2008c273"
         "108310088ccef088c23110866662366c217e880ff08718e2399c2aaaaff0f0f5a5a633cc83c3c255aa89696fa55af73ce213c88324c"
         "23bdc269962c33cf9966f066060272604e424e40627208c936f936cf39c62639c29336f9cc6f817efe718fccf0f0fcc277442ee22fa"
         "a6850503f6a5a5040385a5a4200f85450a0a8f3a5a500008fa0a050503f5555a0a0f35a5a5050f8aa5500008faa5555008faaaa5500"
         "6f909090906f949494946fa4a4a4a45fa9a594503f2a0a425038a59450403f0a42505438a5a5a5008f55a0a0a0f3a8a854543f6a6a4"
         "04038a4a450006f1a1a0500a80050a4a453aaa590908f1469691486696914006aa08585a08faa8214145f50a4a450fa6a5a0200f8a9"
         "a580008f5090a0a8f3a8a090503f242424245a00aa55006a24924924a8244992248950a50a50fa500aa550f6aaaa44443f66660000f"
         "8a5a0a5a05f50a050a0f369286928f644aaaa44f666666600f8aa4444443f54a854a8f3958095805f969696005fa85454a85f809595"
         "808faa1414145f96960000afaaaa14145fa05050a0afa0a5a5a08f96000000df40804080f3a9a8a9a8cfaaaaaa443f2a4a525438")
Grid = collections.namedtuple("Grid", "name frames origin cells nodes lo span background roots")

def check(ok, what):
    return ok or sys.exit(f"volpack_reader: {what}")
def f32(x):
    return ctypes.c_float(x).value
def fields(number, widths):
    """A number cut into fields of some bits each, lowest first."""
    return [number >> at & (1 << bits) - 1 for at, bits in zip(itertools.accumulate(widths, initial=0), widths)]
def ravel(p, sizes=(8, 8, 8)):
    return (p[0] * sizes[1] + p[1]) * sizes[2] + p[2]

def bc4(bits):
    """A block's one channel, 16 texels row by row, from 0 to 1."""
    a, b, *codes = fields(bits, [8, 8] + [3] * 16)
    check(a > b or a == b and max(codes) < 6, "a BC4 block has the palette of 6")
    a, b = f32(a / 255), f32(b / 255)
    palette = [a, b] + [f32(f32(f32((7 - i) * a) + f32(i * b)) / 7) if a > b else a for i in range(1, 7)]
    return [[palette[code] for code in codes]]

def bc7(bits):
    """A block's four channels, 16 texels row by row, as bytes."""
    check(bits & 255, "a BC7 block has no mode")
    mode = (bits & -bits).bit_length() - 1
    n, pb, rb, sb, cb, ab, each, shared, ib, ib2 = map(int, MODES[mode])
    part, low = bits >> mode + 1 & (1 << pb) - 1, n * (2 * each + shared)
    digits = PARTS[320 * (n == 3) + 5 * (n - 1) * part:][:5 * (n - 1)]
    subsets = fields(int("0" + digits[:4 * (n - 1)], 16), [n - 1] * 16)
    anchors = [0] + [int(digit, 16) for digit in digits[4 * (n - 1):]]
    first, second = [ib - (i in anchors) for i in range(16)], [ib2 - (i == 0) for i in range(16 if ib2 else 0)]
    widths = [mode + 1, pb, rb, sb] + [cb] * 6 * n + [ab] * 2 * n + [1] * low + first + second
    _, _, rotation, swap, *rest = fields(bits, widths)
    colour, alpha = [(rest[8 * n + low:][:16], ib), (rest[-16:], ib2 or ib)][::-1 if swap else 1]
    channels = []
    for c, (width, (index, ib)) in enumerate(zip((cb, cb, cb, ab), (colour, colour, colour, alpha))):
        ends, shift = enumerate(rest[2 * n * c:][:2 * n]), 8 - width - (low > 0)
        ends = [end << 1 | rest[8 * n + (e >> shared)] if low else end for e, end in ends]
        ends = [end << shift | end << shift >> 8 - shift if width else 255 for end in ends]
        weights = [(64 * i + (1 << ib >> 1) - 1) // ((1 << ib) - 1) for i in index]
        channels.append([(64 - w) * ends[2 * s] + w * ends[2 * s + 1] + 32 >> 6 for s, w in zip(subsets, weights)])
    channels[3], channels[rotation - 1] = channels[rotation - 1], channels[3]  # 0 swaps the fourth with itself
    return channels

# By tag: bytes of a row of one brick, slices, how to read a block or texel, what stands for 1.
CODECS = {1: (32, 2, bc7, 255), 2: (16, 8, bc4, 1), 3: (8, 8, "B", 255), 4: (16, 8, "e", 0), 5: (32, 8, "f", 0)}

class Pack:
    def __init__(self, path):
        self.data = data = pathlib.Path(path).read_bytes()
        magic, major, _, sections, chunks, _, size, digest = struct.unpack_from("<8sHHIIIQ32s", data.ljust(64))
        table, end = 64 + 80 * sections, 64 + 80 * sections + 48 * chunks
        check(magic == b"\x89VOLPK\r\n" and major == 1 and end <= size == len(data), "no .volpack file, or not whole")
        check(not blake3 or blake3.blake3(data[:32] + bytes(32) + data[64:end]).digest() == digest, "header digest")
        self.chunks, self.encodings, own = list(struct.iter_unpack("<QII32s", data[table:end])), [], {}
        for kind, tag, encoding, _, first, count in struct.iter_unpack("<6I56x", data[64:table]):
            own[kind, tag] = range(first, first + count)
            self.encodings += [encoding] * count
        grids, frames, names, atlases, tree = (b"".join(map(self.chunk, own[kind, 0])) for kind in (1, 2, 3, 4, 6))
        self.tree, self.reals = (struct.unpack(f"<{len(tree) // 4}{form}", tree) for form in "If")
        self.atlases = {tag: (*size, own[7, tag].start) for tag, *size in struct.iter_unpack("<I4x2I8x", atlases)}
        numbers, self.grids = tuple(number for number, in struct.iter_unpack("<4xi192x", frames)), []
        for at, length, first, count in struct.iter_unpack("<II4xII36x", grids):
            head = struct.unpack_from("<3i6I3fI", tree, 4 * self.tree[2] + 64 * len(self.grids))
            self.grids.append(Grid(names[at:at + length].decode(), numbers[first:first + count],
                                   head[:3], head[3:6], head[6:9], *head[9:]))

    @functools.lru_cache(None)
    def chunk(self, number):
        (at, stored, raw, digest), size = self.chunks[number], (1, 1, 2, 4)[self.encodings[number]]
        data, words = self.data[at:at + stored], raw // size
        check(not blake3 or blake3.blake3(data).digest() == digest, f"digest of chunk {number}")
        if stored != raw:
            check(zstd, "chunks are compressed: `pip install zstandard`, or build with `--zstd 0`")
            data = zstd.ZstdDecompressor().decompress(data, max_output_size=raw)
            planes = (data[i * words:(i + 1) * words] for i in range(size))
            data = bytes(itertools.chain.from_iterable(zip(*planes))) + data[size * words:]
        return data

    def children(self, node, bits, only):
        """For each child of the node at a word, or `only` one: the word behind the node's ranks, the child's rank."""
        words = -(-bits // 32)
        for i in range(bits) if only is None else (only,):
            word, rank = self.tree[node + i // 32], self.tree[node + words + i // 64] >> i // 32 % 2 * 16 & 0xFFFF
            if word >> i % 32 & 1:
                yield node + words + -(-words // 2), rank + bin(word & (1 << i % 32) - 1).count("1")

    def walk(self, grid, frame, path=(None, None, None)):
        """The constant links of roots and of cells, and the records' numbers, of a whole frame or on one path."""
        n = math.prod(grid.nodes)
        roots = [self.tree[grid.roots + frame * n + r] for r in (range(n) if path[0] is None else path[:1])]
        cells = [self.tree[links + rank] for root in roots if 0 < root < 1 << 31
                 for links, rank in self.children(root, math.prod(grid.cells), path[1])]
        records = [self.tree[first] + rank for cell in cells if not cell >> 31
                   for first, rank in self.children(self.tree[3] + 193 * cell, 4096, path[2])]
        return [root for root in roots if root >> 31], [cell for cell in cells if cell >> 31], records

    def texels(self, grid, tag, axis, slot, scale):
        """The values that a brick's texels give its 512 voxels."""
        (across, down, first), (size, slices, how, one) = self.atlases[tag], CODECS[tag]
        (slab, q), rows, half = divmod(slot, across * down), 2 if tag < 3 else 8, size // 2
        data, lines = memoryview(self.chunk(first + slab)), itertools.product(range(slices), range(rows))
        starts = ((((t * down + q // across) * rows + r) * across + q % across) * size for t, r in lines)
        brick = b"".join(data[at:at + size] for at in starts)
        if tag < 3:
            blocks = [how(int.from_bytes(brick[at:at + half], "little")) for at in range(0, len(brick), half)]
            places = itertools.product(range(slices), range(8 // slices), range(8), range(8))
            texels = [blocks[4 * t + v // 4 * 2 + u // 4][c][v % 4 * 4 + u % 4] for t, c, v, u in places]
        else:
            texels = struct.unpack(f"<512{how}", brick)
        voxels = [texels[ravel((p.pop(axis), p[1], p[0]))] for p in map(list, itertools.product(range(8), repeat=3))]
        if tag > 3:
            return voxels
        least, extent = struct.unpack("<He", struct.pack("<I", scale))
        values = {k: f32(f32(least / 65535) + f32(extent * f32(k / one))) for k in set(voxels)}
        return [f32(f32(grid.span * values[k]) + grid.lo) for k in voxels]

    @functools.lru_cache(None)
    def region(self, grid, number):
        """The 512 (value, active) of a record."""
        at, back = self.tree[5] + 3 * number, grid.background
        (tag, axis, slot), (mask, rule) = fields(self.tree[at], (3, 2, 27)), fields(self.tree[at + 1], (30, 2))
        values = self.texels(grid, tag, axis, slot, self.tree[at + 2]) if tag else [self.reals[at + 2]] * 512
        masks = [bit for word in self.tree[self.tree[7] + 16 * mask:][:32] for bit in fields(word, [1] * 32)]
        active = masks[:512] if mask < 2 ** 30 - 1 else [value != back for value in values]
        minus = masks[512:] if rule == 2 else [rule] * 512
        return [(v if a or rule == 3 else -back if m else back, bool(a)) for v, a, m in zip(values, active, minus)]

    @functools.lru_cache(None)
    def brick(self, grid, frame, place):
        """The 512 (value, active) of the 8 x 8 x 8 voxels from 8 * place on."""
        at = [8 * p - origin for p, origin in zip(place, grid.origin)]
        node, cell = zip(*(divmod(a // 128, size) for a, size in zip(at, grid.cells)))
        if any(not 0 <= n < size for n, size in zip(node, grid.nodes)):
            return [(grid.background, False)] * 512
        path = ravel(node, grid.nodes), ravel(cell, grid.cells), ravel([a // 8 % 16 for a in at], (16, 16, 16))
        roots, cells, records = self.walk(grid, frame, path)
        if records:
            return self.region(grid, records[0])
        for link in roots + cells:
            return [(self.reals[self.tree[9] + (link & 0x3FFFFFFF)], bool(link >> 30 & 1))] * 512
        return [(grid.background, False)] * 512

    def voxel(self, grid, frame, xyz):
        """The (value, active) of one voxel."""
        return self.brick(grid, frame, tuple(p // 8 for p in xyz))[ravel([p % 8 for p in xyz])]

def fill(pack, wanted):
    """Fills in what a pack has at the voxels and in the boxes that an expectation names."""
    for frame in wanted["frames"]:
        grid = next(grid for grid in pack.grids if grid.name == frame["grid"])
        voxel = functools.partial(pack.voxel, grid, grid.frames.index(frame["frame"]))
        for entry in frame["voxels"]:
            value, active = voxel(entry[:3])
            entry[3:] = [struct.pack(">f", value).hex(), active]
        for box in frame["boxes"]:
            ranges = (range(least, most + 1) for least, most in zip(box["min"], box["max"]))
            voxels = [voxel(at) for at in itertools.product(*ranges)]
            raw = struct.pack("<" + "fB" * len(voxels), *itertools.chain.from_iterable(voxels))
            box.update(crc32=f"{zlib.crc32(raw):08x}", active=sum(active for _, active in voxels))
    return wanted

if __name__ == "__main__":
    pack = Pack(sys.argv[1])
    if len(sys.argv) > 2:
        text = json.dumps(fill(pack, json.loads(pathlib.Path(sys.argv[2]).read_text())))
        sys.exit(print(text.replace("}, {", "},\n{").replace("[[", "[\n[").replace("], [", "],\n[")))
    for grid, (f, number) in ((grid, frame) for grid in pack.grids for frame in enumerate(grid.frames)):
        roots, cells, records = pack.walk(grid, f)
        regions = [pack.region(grid, record) for record in records]
        raw = (struct.pack("<" + "fB" * 512, *itertools.chain.from_iterable(region)) for region in regions)
        print(json.dumps({"grid": grid.name, "frame": number, "voxels": 512 * len(regions),
                          "active": sum(active for region in regions for _, active in region),
                          "crc32": f"{zlib.crc32(b''.join(raw)):08x}", "constants": [len(roots), len(cells)]}))
