//! Several pictures in one, each with its frame's number.

/// A picture of one frame.
pub struct Picture {
    /// The frame's number.
    pub number: i32,
    /// 8-bit RGB, row by row.
    pub rgb: Vec<u8>,
}

/// Frames left to right and top to bottom, in a sheet about as wide as it is high. Returns its size and its pixels.
pub fn contact_sheet([width, height]: [u32; 2], pictures: &[Picture]) -> ([u32; 2], Vec<u8>) {
    let square = (1..).find(|c| c * c >= pictures.len()).expect("some square is large enough");
    // Up to half again as wide as high, if that leaves fewer places empty.
    let empty = |columns: &usize| pictures.len().next_multiple_of(*columns) - pictures.len();
    let columns = (square..=square * 3 / 2).min_by_key(empty).expect("the range has its first");
    let rows = pictures.len().div_ceil(columns);
    let stride = width as usize * 3;
    let mut sheet = vec![0; stride * columns * height as usize * rows];
    for (i, picture) in pictures.iter().enumerate() {
        let mut rgb = picture.rgb.clone();
        write_number(&mut rgb, [width, height], picture.number);
        for (y, row) in rgb.chunks_exact(stride).enumerate() {
            let at = ((i / columns * height as usize + y) * columns + i % columns) * stride;
            sheet[at..at + stride].copy_from_slice(row);
        }
    }
    ([width * columns as u32, height * rows as u32], sheet)
}

/// Digits and the minus sign, three pixels wide and five high: a row from the top is three bits.
const GLYPHS: [[u8; 5]; 11] = [
    [7, 5, 5, 5, 7],
    [2, 6, 2, 2, 7],
    [7, 1, 7, 4, 7],
    [7, 1, 7, 1, 7],
    [5, 5, 7, 1, 1],
    [7, 4, 7, 1, 7],
    [7, 4, 7, 5, 7],
    [7, 1, 1, 1, 1],
    [7, 5, 7, 5, 7],
    [7, 5, 7, 1, 7],
    [0, 0, 7, 0, 0],
];
const MINUS: usize = 10;

/// Draws a number into the lower left corner, a twenty-fifth of the picture's height, if there is room.
fn write_number(rgb: &mut [u8], [width, height]: [u32; 2], number: i32) {
    let scale = (height / 125).max(1);
    let text = number.to_string();
    let (wide, high) = (text.len() as u32 * 4 * scale, 5 * scale);
    let (left, top) = (2 * scale, height.saturating_sub(high + 2 * scale));
    if left + wide > width || top + high > height {
        return;
    }
    for (i, character) in text.chars().enumerate() {
        let glyph = GLYPHS[character.to_digit(10).map_or(MINUS, |digit| digit as usize)];
        for y in 0..high {
            for x in 0..3 * scale {
                if glyph[(y / scale) as usize] >> (2 - x / scale) & 1 == 1 {
                    let at = ((top + y) * width + left + i as u32 * 4 * scale + x) as usize * 3;
                    rgb[at..at + 3].fill(255);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_sheet_has_every_picture_in_its_place_and_its_number_on_it() {
        let picture = |number: i32| Picture { number, rgb: vec![number as u8 * 10; 8 * 8 * 3] };
        let pictures: Vec<_> = (1..=5).map(picture).collect();
        let ([width, height], sheet) = contact_sheet([8, 8], &pictures);
        assert_eq!([width, height], [24, 16]);
        let at = |x: u32, y: u32| sheet[((y * width + x) * 3) as usize];
        assert_eq!(
            [at(0, 0), at(8, 0), at(23, 0), at(0, 8), at(15, 15), at(23, 15)],
            [10, 20, 30, 40, 50, 0]
        );
        // A 1: its foot is three pixels wide.
        assert_eq!([1, 2, 3, 4, 5].map(|x| at(x, 5)), [10, 255, 255, 255, 10]);
        // Where there is no room for it, there is none.
        let (_, small) = contact_sheet([4, 4], &[Picture { number: -12, rgb: vec![7; 4 * 4 * 3] }]);
        assert!(small.iter().all(|v| *v == 7));
    }
}
