//! Builds the crate again when a file appears in the folders whose contents are embedded in it.

fn main() {
    println!("cargo:rerun-if-changed=static");
    println!("cargo:rerun-if-changed=migrations");
}
