//! All that a build knows of each codec, beside what readers know of it ([`volpack_format::codec`]). A new one is its encoder
//! and a row here.

use serde::{Serialize, Serializer};

use super::{Codec, EncodedBricks, OutOfRange, SequenceRange, Texels, bc4, bc7, plain};
use crate::volume::BRICK_VOXELS;

type Voxels = [f32; BRICK_VOXELS];

/// One codec that has texels.
struct Row {
    codec: Codec,
    /// In the help of `--format`.
    help: &'static str,
    encode: fn(&SequenceRange, &[Texels]) -> Result<EncodedBricks, OutOfRange>,
    trial: TrialPolicy,
    /// Of its bytes in the report, as CSS has it; from Okabe and Ito's palette.
    color: &'static str,
}

/// When an adaptive build tries a codec on a brick, and what it keeps of that.
#[derive(Clone, Copy)]
pub enum TrialPolicy {
    /// On every brick. Texels and errors are kept on this machine.
    Always,
    /// On bricks for which the search would choose it, since it is slow. Texels and errors are kept, on remotes too.
    OnDemand,
    /// On every brick, without its encoder: the function rounds values as texels do, and gives `None` if one does not fit.
    /// Only errors are kept, because texels are as quick to make as to read back.
    ErrorOnly(fn(&Voxels) -> Option<Voxels>),
    /// On none: there is no error.
    Exact,
}

/// By ascending bits; the last is exact.
static TABLE: [Row; Codec::WITH_TEXELS.len()] = [
    Row {
        codec: Codec::Bc7,
        help: "BC7 blocks, 2 bits per voxel",
        encode: |sequence, bricks| Ok(bc7::encode(sequence, bricks)),
        // Twenty times as long as all others together.
        trial: TrialPolicy::OnDemand,
        color: "#009e73",
    },
    Row {
        codec: Codec::Bc4,
        help: "BC4 blocks, 4 bits per voxel",
        encode: |sequence, bricks| {
            Ok(EncodedBricks::without_axes(bc4::encode(sequence, bricks), bricks.len()))
        },
        trial: TrialPolicy::Always,
        color: "#0072b2",
    },
    Row {
        codec: Codec::Unorm8,
        help: "8 bits per voxel",
        encode: |sequence, bricks| {
            Ok(EncodedBricks::without_axes(plain::encode_unorm8(sequence, bricks), bricks.len()))
        },
        trial: TrialPolicy::Always,
        color: "#56b4e9",
    },
    Row {
        codec: Codec::F16,
        help: "16-bit floats, exact where the source is half",
        encode: |_, bricks| Ok(EncodedBricks::without_axes(plain::encode_f16(bricks)?, bricks.len())),
        trial: TrialPolicy::ErrorOnly(plain::round_to_f16),
        color: "#cc79a7",
    },
    Row {
        codec: Codec::F32,
        help: "32-bit floats, lossless",
        encode: |_, bricks| Ok(EncodedBricks::without_axes(plain::encode_f32(bricks), bricks.len())),
        trial: TrialPolicy::Exact,
        color: "#d55e00",
    },
];

// The search takes the first that is good enough, and the last when none is.
const _: () = {
    let mut i = 0;
    while i + 1 < TABLE.len() {
        assert!(TABLE[i].codec.layout().brick_bytes() <= TABLE[i + 1].codec.layout().brick_bytes());
        assert!(!matches!(TABLE[i].trial, TrialPolicy::Exact));
        i += 1;
    }
    assert!(matches!(TABLE[i].trial, TrialPolicy::Exact));
};

/// A codec that has texels: one that a build can choose. The number is its place in the table, which searches look up more
/// than anything else.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TexelCodec(u8);

impl TexelCodec {
    /// All of them, by ascending bits.
    pub const ALL: [Self; TABLE.len()] = {
        let mut all = [Self(0); TABLE.len()];
        let mut i = 0;
        while i < all.len() {
            all[i] = Self(i as u8);
            i += 1;
        }
        all
    };

    /// BC7.
    pub const BC7: Self = Self::named(Codec::Bc7);
    /// BC4.
    pub const BC4: Self = Self::named(Codec::Bc4);
    /// One byte a voxel.
    pub const UNORM8: Self = Self::named(Codec::Unorm8);
    /// Half floats.
    pub const F16: Self = Self::named(Codec::F16);
    /// Floats.
    pub const F32: Self = Self::named(Codec::F32);

    const fn named(codec: Codec) -> Self {
        Self::of(codec).expect("it is in the table")
    }

    /// The one without error, which any brick can have.
    pub const EXACT: Self = Self::ALL[Self::ALL.len() - 1];

    /// Those of [`TrialPolicy::ErrorOnly`].
    pub const ERROR_ONLY: [Self; Self::count_error_only()] = {
        let mut found = [Self::EXACT; Self::count_error_only()];
        let (mut i, mut next) = (0, 0);
        while i < TABLE.len() {
            if matches!(TABLE[i].trial, TrialPolicy::ErrorOnly(_)) {
                found[next] = Self(i as u8);
                next += 1;
            }
            i += 1;
        }
        found
    };

    const fn count_error_only() -> usize {
        let (mut i, mut count) = (0, 0);
        while i < TABLE.len() {
            count += matches!(TABLE[i].trial, TrialPolicy::ErrorOnly(_)) as usize;
            i += 1;
        }
        count
    }

    /// A codec, if it has texels.
    pub const fn of(codec: Codec) -> Option<Self> {
        let mut i = 0;
        while i < TABLE.len() {
            if TABLE[i].codec as u8 == codec as u8 {
                return Some(Self(i as u8));
            }
            i += 1;
        }
        None
    }

    /// Its place in [`Self::ALL`].
    pub const fn index(self) -> usize {
        self.0 as usize
    }

    const fn row(self) -> &'static Row {
        &TABLE[self.index()]
    }

    /// As one of all codecs.
    pub const fn codec(self) -> Codec {
        self.row().codec
    }

    /// Its name in manifests and reports.
    pub const fn name(self) -> &'static str {
        self.codec().name()
    }

    /// What the help says of it.
    pub fn help(self) -> &'static str {
        self.row().help
    }

    /// When adaptive builds try it, and what they keep of that.
    pub fn trial_policy(self) -> TrialPolicy {
        self.row().trial
    }

    /// Whether its texels are kept once they are made.
    pub fn keeps_texels(self) -> bool {
        matches!(self.trial_policy(), TrialPolicy::Always | TrialPolicy::OnDemand)
    }

    /// Whether it is tried only on bricks for which the search would choose it.
    pub fn is_on_demand(self) -> bool {
        matches!(self.trial_policy(), TrialPolicy::OnDemand)
    }

    /// Some values as its texels give them back: `None` where it cannot hold one.
    ///
    /// # Panics
    /// For a codec that is not of [`TrialPolicy::ErrorOnly`].
    pub fn round(self, values: &Voxels) -> Option<Voxels> {
        let TrialPolicy::ErrorOnly(round) = self.trial_policy() else {
            panic!("{} is tried with its encoder", self.name());
        };
        round(values)
    }

    /// The colour of its bytes in the report, as CSS has it.
    pub fn color(self) -> &'static str {
        self.row().color
    }

    /// Encodes some bricks, on this thread.
    pub(super) fn encode_batch(
        self,
        sequence: &SequenceRange,
        bricks: &[Texels],
    ) -> Result<EncodedBricks, OutOfRange> {
        (self.row().encode)(sequence, bricks)
    }
}

impl Serialize for TexelCodec {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        // In keys of the cache, where a codec has had this number from the first: its tag less one.
        serializer.serialize_u32(self.codec() as u32 - 1)
    }
}
