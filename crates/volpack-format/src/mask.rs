//! Bit masks, in OpenVDB's order: bit `n` of a brick is voxel `x << 6 | y << 3 | z`.

/// One bit for each voxel of a brick.
#[derive(Clone, Copy, PartialEq, Eq, Hash, bytemuck::Pod, bytemuck::Zeroable, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize), serde(transparent))]
#[repr(transparent)]
pub struct Mask512(pub [u64; 8]);

impl std::fmt::Debug for Mask512 {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "Mask512({} on)", self.count())
    }
}

/// The weights of eight voxels, for each byte of a mask.
static WEIGHTS: [[f32; 8]; 256] = {
    let mut all = [[0.0; 8]; 256];
    let mut i = 0;
    while i < 256 * 8 {
        all[i / 8][i % 8] = (((i / 8) >> (i % 8)) & 1) as f32;
        i += 1;
    }
    all
};

impl Mask512 {
    /// Every voxel off.
    pub const NONE: Self = Self([0; 8]);
    /// Every voxel on.
    pub const ALL: Self = Self([u64::MAX; 8]);

    /// Reads the 64 little-endian bytes that OpenVDB stores.
    pub fn from_bytes(bytes: &[u8; 64]) -> Self {
        let mut words = [0; 8];
        for (word, chunk) in words.iter_mut().zip(bytes.as_chunks::<8>().0) {
            *word = u64::from_le_bytes(*chunk);
        }
        Self(words)
    }

    /// The voxels that are on in either.
    pub fn union(&self, other: &Self) -> Self {
        Self(std::array::from_fn(|i| self.0[i] | other.0[i]))
    }

    /// How many voxels are on.
    pub fn count(&self) -> u32 {
        self.0.iter().map(|w| w.count_ones()).sum()
    }

    /// Whether voxel `index` is on.
    pub fn get(&self, index: usize) -> bool {
        self.0[index >> 6] >> (index & 63) & 1 != 0
    }

    /// Turns voxel `index` on.
    pub fn set(&mut self, index: usize) {
        self.0[index >> 6] |= 1 << (index & 63);
    }

    /// The indices that are on, ascending.
    pub fn ones(&self) -> impl Iterator<Item = usize> + '_ {
        bits(&self.0)
    }

    /// 1 for each voxel that is on and 0 for the others, to multiply with.
    pub fn weights(&self) -> [f32; 512] {
        let mut weights = [0.0; 512];
        let bytes = self.0.iter().flat_map(|word| word.to_le_bytes());
        for (weights, byte) in weights.as_chunks_mut::<8>().0.iter_mut().zip(bytes) {
            *weights = WEIGHTS[usize::from(byte)];
        }
        weights
    }

    /// The mask's 16 words as a pack stores them: bit `n` is bit `n % 32` of word `n / 32`.
    pub fn to_words(&self) -> [u32; 16] {
        std::array::from_fn(|i| (self.0[i / 2] >> (32 * (i & 1))) as u32)
    }

    /// The inverse of [`Mask512::to_words`].
    pub fn from_words(words: &[u32; 16]) -> Self {
        Self(std::array::from_fn(|i| u64::from(words[2 * i]) | u64::from(words[2 * i + 1]) << 32))
    }
}

/// The positions of the bits that are on, ascending.
pub fn bits(words: &[u64]) -> impl Iterator<Item = usize> + '_ {
    words.iter().enumerate().flat_map(|(i, &word)| {
        let mut rest = word;
        std::iter::from_fn(move || {
            (rest != 0).then(|| {
                let bit = rest.trailing_zeros() as usize;
                rest &= rest - 1;
                i * 64 + bit
            })
        })
    })
}
