//! Reads a pack in WebAssembly and says what it found, for `cargo xtask wasm` to compare with the same read natively.

use std::cell::RefCell;

use volpack_format::{Pack, PackError, Region};

/// Reads every brick of every frame: a line a frame, with the number of its bricks, the sum of their voxels, and a hash of
/// all their bits.
///
/// # Errors
/// [`PackError`].
pub fn summary(bytes: Vec<u8>) -> Result<String, PackError> {
    let pack = Pack::from_bytes(bytes)?;
    pack.check_chunks()?;
    let mut lines = String::new();
    for (g, grid) in pack.grids().iter().enumerate() {
        for f in 0..grid.frames.len() {
            let reader = pack.frame(g, f)?;
            let mut records = Vec::new();
            reader.for_each_region(|_, _, region| {
                if let Region::Brick(record) = region {
                    records.push(record);
                }
            });
            // FNV-1a over the bits of values and masks.
            let (mut sum, mut hash) = (0f64, 0xcbf2_9ce4_8422_2325u64);
            let mut add = |word: u64| hash = (hash ^ word).wrapping_mul(0x0000_0100_0000_01b3);
            for record in &records {
                let brick = reader.decode(record)?;
                brick.values.iter().for_each(|value| add(value.to_bits().into()));
                brick.active.0.iter().for_each(|word| add(*word));
                sum += brick.values.iter().map(|value| f64::from(*value)).sum::<f64>();
            }
            let (name, number) = (&grid.name, grid.frames[f].record.number);
            lines += &format!("{name} {number}: {} bricks, sum {sum}, hash {hash:016x}\n", records.len());
        }
    }
    Ok(lines)
}

thread_local! {
    static INPUT: RefCell<Vec<u8>> = const { RefCell::new(Vec::new()) };
    static OUTPUT: RefCell<String> = const { RefCell::new(String::new()) };
}

/// Makes room for a pack of that many bytes. Its address is where to put them.
#[allow(unsafe_code)]
// SAFETY: no other crate of the module has functions of these names.
#[unsafe(no_mangle)]
pub extern "C" fn volpack_input(bytes: usize) -> *mut u8 {
    INPUT.with_borrow_mut(|input| {
        *input = vec![0; bytes];
        input.as_mut_ptr()
    })
}

/// Reads that pack, and gives the number of bytes of [`summary`] or of the error, which begin at [`volpack_output`].
#[allow(unsafe_code)]
// SAFETY: as above.
#[unsafe(no_mangle)]
pub extern "C" fn volpack_read() -> usize {
    let text = summary(INPUT.take()).unwrap_or_else(|error| format!("error: {error}\n"));
    OUTPUT.with_borrow_mut(|output| {
        *output = text;
        output.len()
    })
}

/// Where they begin.
#[allow(unsafe_code)]
// SAFETY: as above.
#[unsafe(no_mangle)]
pub extern "C" fn volpack_output() -> *const u8 {
    OUTPUT.with_borrow(|output| output.as_ptr())
}
