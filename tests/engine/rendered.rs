//! Photographs of the synthetic temple, rendered once for all tests of this program.

use std::path::{Path, PathBuf};
use std::sync::OnceLock;

use super::multistage;

/// Number of the photographs.
pub const NUM_PHOTOGRAPHS: usize = 14;

/// A folder with the photographs of the temple, `temple_000.jpg` and so on, all of them fit for one model.
pub fn photographs() -> PathBuf {
    static RENDERED: OnceLock<tempfile::TempDir> = OnceLock::new();
    let folder = RENDERED.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let spec = folder.path().join("spec.json");
        let options = serde_json::json!({
            "scene": "temple", "num_images": NUM_PHOTOGRAPHS, "arc_deg": 180, "width": 640, "height": 480,
        });
        std::fs::write(&spec, options.to_string()).unwrap();
        let out = folder.path().to_str().unwrap();
        let rendered = multistage(&["synthesize", spec.to_str().unwrap(), "--out", out]);
        assert!(rendered.status.success(), "{}", String::from_utf8_lossy(&rendered.stderr));
        folder
    });
    folder.path().join("images")
}

/// Copies a file of one folder into another.
pub fn copy(from: &Path, to: &Path, name: &str) {
    std::fs::copy(from.join(name), to.join(name)).unwrap();
}
