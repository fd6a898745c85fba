//! The eight stages, one module each. A stage knows only its neighbours' types:
//!
//! | | stage | gives |
//! |---|---|---|
//! | 1 | [`metadata`] | [`metadata::SequenceInfo`]: every file's header and grids |
//! | 2 | [`select`] | [`select::Selection`]: the grids to pack, their frames, and what of their values |
//! | 3 | [`flatten`] | [`crate::volume::FlatFrame`]: cells and bricks of one frame |
//! | 4 | [`dedup`] | [`dedup::SequenceTree`]: nodes and bricks shared across the sequence |
//! | 5, 7 | [`encoder_cache`] | what each codec makes of each brick, made once |
//! | 5 | [`allocate`] | [`allocate::Allocation`]: which codec each brick gets, and its range |
//! | 6 | [`relayout`] | [`relayout::Placement`]: where each brick lies in the pages of its codec's texture |
//! | 7 | [`quantise`] | encoded slabs of each atlas |
//! | 8 | [`serialise`] | the `.volpack` file |

pub mod allocate;
pub mod dedup;
pub mod encoder_cache;
pub mod flatten;
pub mod metadata;
pub mod quantise;
pub mod relayout;
pub mod select;
pub mod serialise;
