//! What each rung comes to for a brick, and what is exact of it.

use std::collections::HashMap;
use std::io;

use super::rung::Rung;
use super::share::Loan;
use crate::stages::encodings::{Cost, Encodings, KeptCodec, Kind};

/// An L3 record is three words.
pub(super) const RECORD_BITS: u32 = 96;

/// What the rungs come to that have a cost of their own, in squared peaks. Looked up some hundred times a brick, and
/// there for every brick of a sequence: so half as wide as costs are, and 48 bytes. They serve to choose between rungs;
/// what a chosen one costs is read from the encodings.
#[derive(Clone, Copy)]
struct Choices {
    /// Over all users and over all the voxels that texels give.
    distortion: [f32; Rung::OWN],
    /// Over active voxels.
    active_squares: [f32; Rung::OWN],
}

impl Choices {
    const NONE: Self = Self { distortion: [0.0; Rung::OWN], active_squares: [0.0; Rung::OWN] };

    /// Notes squares. What is infinite is out of the question, so nothing else may be.
    fn set(&mut self, rung: Rung, distortion: f64, active_squares: f64) {
        let Some(i) = rung.own() else { return };
        let narrow = |v: f64| if v.is_infinite() { f32::INFINITY } else { (v as f32).min(f32::MAX) };
        (self.distortion[i], self.active_squares[i]) = (narrow(distortion), narrow(active_squares));
    }

    /// The distortion of a rung that has one of its own, or none at all.
    fn distortion(&self, rung: Rung) -> f64 {
        rung.own().map_or(0.0, |i| self.distortion[i].into())
    }

    /// The same over active voxels.
    fn active_squares(&self, rung: Rung) -> f64 {
        rung.own().map_or(0.0, |i| self.active_squares[i].into())
    }
}

/// What every rung comes to for every brick.
pub(super) struct Table {
    /// How often each brick is used over all frames.
    pub uses: Vec<u32>,
    /// How many L3 records each brick has: one in every run that it is in.
    pub records: Vec<u32>,
    /// Maximum less minimum of active values.
    pub peak: f64,
    choices: Vec<Choices>,
    /// What bricks borrow, and which of them do.
    loans: HashMap<u32, Loan>,
    has_loan: Vec<bool>,
}

impl Table {
    /// Nothing costs anything yet.
    pub fn new(uses: Vec<u32>, records: Vec<u32>, peak: f64) -> Self {
        let (choices, has_loan) = (vec![Choices::NONE; uses.len()], vec![false; uses.len()]);
        Self { uses, records, peak, choices, loans: HashMap::new(), has_loan }
    }

    /// How many bricks there are.
    pub fn len(&self) -> usize {
        self.uses.len()
    }

    /// Notes what a rung comes to for a brick.
    pub fn weigh(&mut self, id: u32, rung: Rung, cost: Cost) {
        let distortion = self.in_peaks(cost.norm) * f64::from(self.uses[id as usize]);
        let active_squares = self.in_peaks(cost.active_norm);
        self.choices[id as usize].set(rung, distortion, active_squares);
    }

    /// A brick's error in squared peaks, over all its users and over all the voxels that its texels give. That of a
    /// codec that was not tried is none.
    pub fn distortion(&self, brick: usize, rung: Rung) -> f64 {
        let borrowed = |loan: &Loan| self.in_peaks(loan.cost.norm) * f64::from(self.uses[brick]);
        match rung {
            Rung::Borrowed => self.loan(brick).map_or(f64::INFINITY, borrowed),
            rung => self.choices[brick].distortion(rung),
        }
    }

    /// The same for one user, over active voxels.
    pub fn active_squares(&self, brick: usize, rung: Rung) -> f64 {
        let borrowed = |loan: &Loan| self.in_peaks(loan.cost.active_norm);
        match rung {
            Rung::Borrowed => self.loan(brick).map_or(f64::INFINITY, borrowed),
            rung => self.choices[brick].active_squares(rung),
        }
    }

    /// An error in squared peaks.
    pub fn in_peaks(&self, norm: f64) -> f64 {
        // Where all active values are the same, nothing but no error will do.
        let peak = if self.peak > 0.0 { self.peak } else { f64::MIN_POSITIVE };
        if norm == 0.0 { 0.0 } else { (norm / peak) * (norm / peak) }
    }

    /// The bits of a brick's texels and of all its records.
    pub fn bits(&self, brick: usize, rung: Rung) -> f64 {
        let records = if rung == Rung::Empty { 0 } else { self.records[brick] };
        f64::from(rung.texel_bits()) + f64::from(RECORD_BITS) * f64::from(records)
    }

    /// What a brick borrows.
    pub fn loan(&self, brick: usize) -> Option<&Loan> {
        // Most have none, and a look at a flag is less than one into a map.
        if self.has_loan[brick] { self.loans.get(&(brick as u32)) } else { None }
    }

    /// Gives a brick a loan.
    pub fn lend(&mut self, id: u32, loan: Loan) {
        self.loans.insert(id, loan);
        self.has_loan[id as usize] = true;
    }

    /// Ends all loans but some.
    pub fn keep_loans(&mut self, is_kept: impl Fn(u32, &Loan) -> bool) {
        self.loans.retain(|&id, loan| is_kept(id, loan));
        self.has_loan.fill(false);
        self.loans.keys().for_each(|&id| self.has_loan[id as usize] = true);
    }

    /// Ends all loans.
    pub fn forget_loans(&mut self) {
        self.keep_loans(|_, _| false);
    }

    /// All loans.
    pub fn into_loans(self) -> HashMap<u32, Loan> {
        self.loans
    }
}

/// What rungs do to some bricks, by [`Rung::ALL`], and [`Rung::Constant`]'s values. What was not tried costs nothing,
/// and loans are not among it.
pub(super) fn costs(
    encodings: &Encodings,
    ids: &[u32],
    bc7_is_tried: &[bool],
) -> io::Result<Vec<([Cost; Rung::ALL.len()], f32)>> {
    let mut all = Vec::with_capacity(ids.len());
    for plain in encodings.plain(ids)? {
        let mut costs = [Cost::NONE; Rung::ALL.len()];
        costs[Rung::Empty as usize] = plain.empty;
        costs[Rung::Constant as usize] = plain.constant;
        costs[Rung::F16 as usize] = plain.f16;
        costs[Rung::Borrowed as usize] = Cost::IMPOSSIBLE;
        all.push((costs, plain.value));
    }
    for (rung, codec) in [(Rung::Bc4, KeptCodec::Bc4), (Rung::Unorm8, KeptCodec::Unorm8)] {
        for ((costs, _), cost) in all.iter_mut().zip(encodings.costs(ids, codec)?) {
            costs[rung as usize] = cost;
        }
    }
    let tried = || (0..ids.len()).filter(|&i| bc7_is_tried[ids[i] as usize]);
    let bc7: Vec<u32> = tried().map(|i| ids[i]).collect();
    for (i, cost) in tried().zip(encodings.costs(&bc7, KeptCodec::Bc7)?) {
        all[i].0[Rung::Bc7 as usize] = cost;
    }
    Ok(all)
}

/// What all bricks are tried with before anything is chosen: BC7 takes twenty times as long as all of it, and is tried
/// when it is asked for.
pub(super) const AT_ONCE: [Kind; 3] =
    [Kind::Plain, Kind::Texels(KeptCodec::Bc4), Kind::Texels(KeptCodec::Unorm8)];
