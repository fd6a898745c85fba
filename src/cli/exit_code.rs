//! The exit code of each kind of failure, as `volpack help` lists them.

use std::io::ErrorKind;

use crate::error::Error;

/// What shells say of a process that Ctrl-C ended.
pub const INTERRUPTED: u8 = 130;

/// The exit code of a failure.
pub fn of(error: &Error) -> u8 {
    match error {
        Error::Io { source, .. } => match source.kind() {
            ErrorKind::NotFound
            | ErrorKind::PermissionDenied
            | ErrorKind::IsADirectory
            | ErrorKind::InvalidData => 3,
            _ => 1,
        },
        Error::InUse(_) | Error::Other(_) => 1,
        Error::Usage(_) => 2,
        Error::Vdb { source, .. } if source.is_unsupported() => 6,
        Error::Pack { source, .. } if source.is_unsupported() => 6,
        Error::Provenance { source, .. } if source.is_unsupported() => 6,
        Error::Vdb { .. } | Error::Pack { .. } | Error::Provenance { .. } => 3,
        Error::Manifest { .. } | Error::Input(_) => 3,
        Error::Changed(_) | Error::Misled(_) => 3,
        Error::OutOfRange { .. } => 3,
        Error::Verify(_) => 4,
        Error::Budget(_) => 5,
        Error::Unsupported(_) => 6,
        Error::Cancelled(_) => INTERRUPTED,
    }
}
