//! Links what `intel_tex_2`'s prebuilt ISPC kernels refer to and do not ask for themselves.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    let cfg = |key: &str| std::env::var(format!("CARGO_CFG_TARGET_{key}")).unwrap_or_default();
    match (cfg("OS").as_str(), cfg("ENV").as_str()) {
        // The kernels are those for MSVC, and its runtime has two symbols that MinGW's does not: the stack probe, which has
        // another name there, and a mark of objects that use floats, which is only referred to and never read.
        ("windows", "gnu") => {
            println!("cargo:rustc-link-arg=-Wl,--defsym=__chkstk=___chkstk_ms");
            println!("cargo:rustc-link-arg=-Wl,--defsym=_fltused=0");
        }
        ("windows", _) => {}
        // The C++ runtime, for `__gxx_personality_v0`.
        ("macos", _) => println!("cargo:rustc-link-lib=dylib=c++"),
        _ => println!("cargo:rustc-link-lib=dylib=stdc++"),
    }
}
