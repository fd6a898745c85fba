//! Names of files that every system takes: manifests and reports are shared by people on different ones.

use std::path::{Component, MAIN_SEPARATOR, Path};

/// What Windows takes for a device, whatever the case and the extension: what is written to `nul.volpack` is gone.
/// <https://learn.microsoft.com/windows/win32/fileio/naming-a-file>
const DEVICES: [&str; 6] = ["CON", "PRN", "AUX", "NUL", "CONIN$", "CONOUT$"];
/// Those that have a digit from 1 to 9 behind them.
const NUMBERED_DEVICES: [&str; 2] = ["COM", "LPT"];

/// Checks all folders of a path and its file name.
///
/// # Errors
/// What is wrong with the first that not every system takes, and what to do.
pub(crate) fn check_path(path: &Path) -> Result<(), String> {
    path.components().try_for_each(|component| match component {
        Component::Normal(name) => check_name(&name.to_string_lossy()),
        _ => Ok(()),
    })
}

/// Checks the name of a file or a folder.
///
/// # Errors
/// As [`check_path`].
pub(crate) fn check_name(name: &str) -> Result<(), String> {
    if name.ends_with(['.', ' ']) {
        return Err(format!(
            "{name:?} ends with a dot or a space, which Windows removes: choose another name"
        ));
    }
    let stem = name.split('.').next().unwrap_or(name).trim_end().to_uppercase();
    let is_numbered = |device: &&str| {
        let mut rest = stem.strip_prefix(*device).unwrap_or_default().chars();
        // Superscripts too: in old code pages they are digits.
        matches!((rest.next(), rest.next()), (Some('1'..='9' | '¹' | '²' | '³'), None))
    };
    if DEVICES.contains(&&*stem) || NUMBERED_DEVICES.iter().any(is_numbered) {
        return Err(format!("{name:?} is the name of a device on Windows: choose another name"));
    }
    Ok(())
}

/// A path as manifests and reports have it on every system, so that they can be compared: with slashes.
pub(crate) fn portable(path: &Path) -> String {
    // No more than the separator of this system: elsewhere, a backslash is a part of a name.
    path.to_string_lossy().replace(MAIN_SEPARATOR, "/")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_that_windows_does_not_take_are_refused_on_every_system() {
        for name in
            ["NUL", "nul.volpack", "Con.tar.gz", "aux", "prn.png", "com1", "LPT9.volpack", "lpt².x", "nul .x"]
        {
            let error = check_name(name).unwrap_err();
            assert_eq!(error, format!("{name:?} is the name of a device on Windows: choose another name"));
        }
        for name in ["puff.", "puff ", "puff.volpack ", "..."] {
            assert!(check_name(name).unwrap_err().contains("ends with a dot or a space"), "{name}");
        }
        for name in [
            "null",
            "com",
            "com0",
            "com10",
            "lpt",
            "console",
            "auxiliary.volpack",
            "a.nul",
            ".nul",
            "x nul",
            "rauch-ä",
        ] {
            assert_eq!(check_name(name), Ok(()), "{name}");
        }
    }

    #[test]
    fn portable_paths_have_slashes() {
        let path = Path::new("project").join("out").join("puff.volpack");
        assert_eq!(portable(&path), "project/out/puff.volpack");
        let with_backslash = if cfg!(windows) { "a/b" } else { "a\\b" };
        assert_eq!(portable(Path::new("a\\b")), with_backslash);
    }

    #[test]
    fn folders_are_checked_too_but_not_what_is_no_name() {
        assert!(check_path(Path::new("out/aux/puff.volpack")).unwrap_err().starts_with("\"aux\""));
        assert_eq!(check_path(Path::new("../out/./puff.volpack")), Ok(()));
    }
}
