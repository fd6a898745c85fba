//! Which bricks of a grid borrow the texels of others.

use super::candidate::Candidate;
use super::choices::Weighed;
use super::offers::TexelReference;
use super::search::GridSearch;
use super::steps::{LAST_STEP, STEPS_PER_OCTAVE, lambda};
use super::texel_references::texel_references;
use crate::error::Result;

/// Steps of λ, a quarter of an octave, that are one when it comes to who lends: 0.4 dB.
const LENDING_STEPS: u32 = STEPS_PER_OCTAVE / 4;

impl GridSearch<'_> {
    /// Finds out which bricks had better borrow, were λ what it is at `step` and every brick coded as in `picks`. A brick
    /// lends or borrows, and one that lends keeps the codec it has.
    pub(super) fn find_references(
        &mut self,
        picks: &[Candidate],
        step: u32,
        advance: &mut dyn FnMut(u64),
    ) -> Result<()> {
        // Who is compared with whom does not change with every little more or less of λ: an edited frame leaves what
        // was found for the frames far from it as it is.
        let near = ((step + LENDING_STEPS / 2) / LENDING_STEPS * LENDING_STEPS).min(LAST_STEP);
        let mut compared = self.picks(near)?;
        while self.try_unknown((0..).zip(compared.iter().copied()), advance)? {
            compared = self.picks(near)?;
        }
        // Who may borrow, and of those who has texels that others can use.
        let whole: Vec<bool> = (0..picks.len() as u32).map(|id| self.encoders.is_whole(id)).collect();
        let borrows = |id: u32| whole[id as usize] && compared[id as usize] != Candidate::Empty;
        let lends =
            |id: u32| compared[id as usize].codec().filter(|codec| borrows(id) && codec.keeps_texels());
        let (table, least_step) = (&self.table, &self.least_step);
        let gain = |id: u32, weighed: Weighed, reference: &TexelReference| {
            let lambda = lambda(step.max(least_step[id as usize].into()));
            let own = picks[id as usize];
            let own = weighed.distortion(own) + lambda * weighed.bits(own);
            own - weighed.borrowed(reference) - lambda * weighed.bits(Candidate::Borrowed)
        };
        // A fifth of the bricks has an offer worth taking.
        let mut order: Vec<(f64, u32, TexelReference)> = Vec::new();
        let (earlier, cancel) = (self.earlier, &self.cancel);
        texel_references(
            self.encoders,
            self.tree,
            borrows,
            lends,
            earlier,
            cancel,
            |ids, texel_references| {
                for ((&id, choices), texel_references) in
                    ids.iter().zip(&table.read(ids)?).zip(texel_references)
                {
                    let as_compared = |reference: &TexelReference| {
                        picks[reference.referenced as usize] == compared[reference.referenced as usize]
                    };
                    let weighed = table.weighed(id, choices);
                    let offers = texel_references.into_iter().filter(as_compared);
                    let offers = offers.map(|reference| (gain(id, weighed, &reference), id, reference));
                    order.extend(offers.filter(|(gain, ..)| *gain > 0.0));
                }
                Ok(())
            },
        )?;
        order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        for (_, id, reference) in order {
            let (referenced, table) = (reference.referenced, &mut self.table);
            if table.reference(id).is_none()
                && self.lends[id as usize].is_none()
                && table.reference(referenced).is_none()
            {
                table.add_reference(id, reference);
                self.lends[referenced as usize] = Some(picks[referenced as usize]);
            }
        }
        Ok(())
    }

    pub(super) fn forget_references(&mut self) {
        self.table.forget_references();
        self.lends.fill(None);
    }

    /// Ends every texel reference that some bricks, ascending, are part of: they are to become finer, and their texels others.
    pub(super) fn call_in_references(&mut self, bricks: &[u32]) {
        for &id in bricks {
            self.lends[id as usize] = None;
        }
        let lends = &self.lends;
        self.table.keep_references(|id, reference| {
            lends[reference.referenced as usize].is_some() && bricks.binary_search(&id).is_err()
        });
    }
}
