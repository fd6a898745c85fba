//! Which frames of a sequence to render.

use std::str::FromStr;

use crate::pack::Frame;

/// Frames as the command line names them.
#[derive(Clone, Debug, PartialEq)]
pub enum Frames {
    /// Every frame.
    All,
    /// Those with these numbers, in this order.
    Numbered(Vec<Range>),
}

/// Every `step`th number from `first` to `last`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Range {
    first: i32,
    last: i32,
    step: u32,
}

impl FromStr for Range {
    type Err = ();

    /// `FIRST`, `FIRST-LAST` or `FIRST-LAST:STEP`; a number may have a sign.
    fn from_str(text: &str) -> Result<Self, ()> {
        let (numbers, step) = match text.split_once(':') {
            Some((numbers, step)) => (numbers, step.parse().map_err(|_| ())?),
            None => (text, 1),
        };
        // The first character may be a sign.
        let dash = numbers.char_indices().skip(1).find(|(_, c)| *c == '-').map(|(i, _)| i);
        let (first, last) = dash.map_or((numbers, numbers), |i| (&numbers[..i], &numbers[i + 1..]));
        let number = |text: &str| text.trim().parse().map_err(|_| ());
        let (first, last) = (number(first)?, number(last)?);
        if first <= last && step > 0 { Ok(Self { first, last, step }) } else { Err(()) }
    }
}

impl Range {
    fn contains(self, number: i32) -> bool {
        let steps = i64::from(number) - i64::from(self.first);
        number >= self.first && number <= self.last && steps % i64::from(self.step) == 0
    }
}

impl FromStr for Frames {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "all" {
            return Ok(Self::All);
        }
        let ranges: Result<Vec<_>, ()> = text.split(',').map(str::parse).collect();
        ranges
            .map(Self::Numbered)
            .map_err(|()| "all, or frame numbers such as 7, 1-24, 1-24:2 or 1,5,9".to_owned())
    }
}

impl Frames {
    /// The frame of this number.
    pub fn one(number: i32) -> Self {
        Self::Numbered(vec![Range { first: number, last: number, step: 1 }])
    }

    /// The places of these frames in a sequence.
    ///
    /// # Errors
    /// No frames at all, or a range in which there is none: it may lie outside of the sequence, or between two frames.
    pub fn places(&self, frames: &[Frame]) -> Result<Vec<usize>, String> {
        let (Some(first), Some(last)) = (frames.first(), frames.last()) else {
            return Err("it has no frames".to_owned());
        };
        let Self::Numbered(ranges) = self else { return Ok((0..frames.len()).collect()) };
        let mut places = Vec::new();
        for range in ranges {
            let before = places.len();
            places.extend((0..frames.len()).filter(|&f| range.contains(frames[f].record.number)));
            if places.len() == before {
                let wanted = match range.first == range.last {
                    true => format!("no frame {}", range.first),
                    false => format!("no frame from {} to {}", range.first, range.last),
                };
                return Err(format!("{wanted}; it has {} to {}", first.record.number, last.record.number));
            }
        }
        Ok(places)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_parsed() {
        let range = |first, last, step| Range { first, last, step };
        assert_eq!("all".parse(), Ok(Frames::All));
        for (text, ranges) in [
            ("7", vec![range(7, 7, 1)]),
            ("1-24:2", vec![range(1, 24, 2)]),
            ("-5--1,3", vec![range(-5, -1, 1), range(3, 3, 1)]),
        ] {
            assert_eq!(text.parse(), Ok(Frames::Numbered(ranges)), "{text}");
        }
        for wrong in ["", "x", "5-1", "1-9:0", "1-", "1,,2", "1:2:3"] {
            assert!(wrong.parse::<Frames>().is_err(), "{wrong}");
        }
        assert!(range(1, 24, 2).contains(23) && !range(1, 24, 2).contains(24));
        assert!(!range(1, 24, 2).contains(25) && !range(1, 24, 1).contains(0));
    }
}
