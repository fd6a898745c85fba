//! Links the C++ runtime that `intel_tex_2`'s prebuilt ISPC kernels refer to
//! (`__gxx_personality_v0`) and do not ask for themselves.

fn main() {
    println!("cargo:rerun-if-changed=build.rs");
    match std::env::var("CARGO_CFG_TARGET_OS").as_deref() {
        Ok("macos") => println!("cargo:rustc-link-lib=dylib=c++"),
        Ok("windows") => {}
        _ => println!("cargo:rustc-link-lib=dylib=stdc++"),
    }
}
