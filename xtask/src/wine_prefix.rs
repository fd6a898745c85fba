//! A place where wine runs programs of Windows, and how it is set up.

use std::error::Error;
use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use crate::windows::{output, succeed};

type Result<T> = std::result::Result<T, Box<dyn Error>>;

/// Wine before 9.0 has no `bcryptprimitives.dll`, from which Rust's standard library takes `ProcessPrng`. `SystemFunction036` is
/// the name that advapi32 exports `RtlGenRandom` under.
const BCRYPTPRIMITIVES: &str = "
__declspec(dllimport) unsigned char __stdcall SystemFunction036(void *, unsigned long);
__declspec(dllexport) int ProcessPrng(unsigned char *bytes, unsigned long long count) {
    return SystemFunction036(bytes, count);
}
";

/// A new folder for wine's registry and drives. No user's settings apply, and no display is needed.
pub struct Prefix {
    folder: tempfile::TempDir,
    wine: PathBuf,
}

impl Prefix {
    /// Creates the folder, with `cc` of MinGW for the DLL that wine lacks.
    ///
    /// # Errors
    /// When wine is missing or does not start.
    pub fn new(cc: &OsStr) -> Result<Self> {
        // Debian's package wine64 alone has no program in a folder of PATH.
        let wine = ["wine64", "wine", "/usr/lib/wine/wine64"]
            .into_iter()
            .find(|program| Command::new(program).arg("--version").output().is_ok())
            .ok_or("wine is missing: on Debian install it with apt-get install wine64")?;
        let prefix = Self { folder: tempfile::tempdir()?, wine: wine.into() };
        let source = prefix.folder.path().join("bcryptprimitives.c");
        fs::write(&source, BCRYPTPRIMITIVES)?;
        let dll = source.with_extension("dll");
        succeed(Command::new(cc).arg("-shared").arg(&source).arg("-o").arg(&dll).arg("-ladvapi32"))?;
        output(prefix.wine().args(["wineboot", "--init"]))?;
        // On the drive of the repository, because tests name its files by paths without a drive. Wine takes these two variables from
        // its registry only.
        let temporary = dos_path(prefix.folder.path());
        for variable in ["TEMP", "TMP"] {
            let add = ["reg", "add", r"HKCU\Environment", "/v", variable, "/d", &temporary, "/f"];
            output(prefix.wine().args(add))?;
        }
        Ok(prefix)
    }

    /// The program that runs a program of Windows.
    pub fn program(&self) -> &Path {
        &self.wine
    }

    /// Runs what it is given as arguments.
    pub fn wine(&self) -> Command {
        let mut command = Command::new(&self.wine);
        self.set_environment(&mut command);
        command
    }

    /// Makes a process, and those that it starts, run wine in this folder.
    pub fn set_environment(&self, command: &mut Command) {
        let folder = self.folder.path();
        command
            .env("WINEPREFIX", folder.join("prefix"))
            .env("WINEPATH", dos_path(folder))
            .env("WINEDEBUG", "-all")
            // Otherwise a new prefix asks for .NET and a browser to be installed.
            .env("WINEDLLOVERRIDES", "mscoree,mshtml=");
    }
}

impl Drop for Prefix {
    fn drop(&mut self) {
        // Otherwise the processes that serve the prefix write into it while it is removed, and complain. The folder is temporary, so
        // a failure does no harm.
        let _ = self.wine().args(["wineboot", "--kill"]).output();
        for server in ["wineserver", "/usr/lib/wine/wineserver"] {
            let mut wait = Command::new(server);
            self.set_environment(&mut wait);
            if wait.arg("--wait").output().is_ok() {
                break;
            }
        }
    }
}

/// The path under which programs of Windows see a file of Linux.
fn dos_path(path: &Path) -> String {
    format!("Z:{}", path.display()).replace('/', "\\")
}
