//! A run that is stopped in the middle of a stage goes on from its last finished unit of work: what was done is not done again, by
//! count, and the outputs are, byte for byte, those of a run that nobody stopped.

#![allow(clippy::unwrap_used)]

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use multistage::formats::report::Report;
use multistage::pipeline::{
    CancelFlag, Context, NoProgress, PipelineError, ProgressEvent, ProgressSink, ReconstructionOptions, RunPaths,
    Stage, reconstruct,
};
use serde_json::json;

/// Stops the run once so many units of a stage are done.
struct StopAt {
    stage: Stage,
    units: u64,
    seen: AtomicU64,
    cancel: CancelFlag,
}

impl ProgressSink for StopAt {
    fn report(&self, event: ProgressEvent) {
        if let ProgressEvent::StageProgress { stage, done, .. } = event
            && stage.stage == self.stage
        {
            self.seen.fetch_max(done, Ordering::SeqCst);
            if done >= self.units {
                self.cancel.cancel();
            }
        }
    }
}

/// Photographs' features of a street, made up.
fn make_scene(folder: &Path, images: usize) {
    let spec = json!({"scene": "features", "layout": "street", "num_images": images, "num_points": 6000,
                      "pixel_noise_px": 0.3, "descriptor_noise": 0.2});
    std::fs::write(folder.join("spec.json"), spec.to_string()).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_multistage"));
    let made = command.arg("synthesize").arg(folder.join("spec.json")).arg("--out").arg(folder.join("scene"));
    assert!(made.output().unwrap().status.success());
}

fn run(folder: &Path, name: &str, options: &ReconstructionOptions, context: &Context) -> Result<Report, PipelineError> {
    let paths = RunPaths {
        images_dir: folder.join("scene/features"),
        out_dir: folder.join(name).join("out"),
        work_dir: folder.join(name).join("work"),
    };
    std::fs::create_dir_all(&paths.out_dir).unwrap();
    reconstruct(&paths, options, context)
}

fn quiet() -> Context {
    Context { seed: 3, threads: 2, cancel: CancelFlag::default(), progress: Arc::new(NoProgress) }
}

/// The models' files; reports speak of times.
fn models(folder: &Path, name: &str) -> BTreeMap<String, Vec<u8>> {
    fn collect(root: &Path, at: &Path, found: &mut BTreeMap<String, Vec<u8>>) {
        for entry in std::fs::read_dir(at).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                collect(root, &path, found);
            } else if !path.file_name().unwrap().to_str().unwrap().starts_with("report.") {
                found.insert(path.strip_prefix(root).unwrap().display().to_string(), std::fs::read(&path).unwrap());
            }
        }
    }
    let root = folder.join(name).join("out");
    let mut found = BTreeMap::new();
    collect(&root, &root, &mut found);
    found
}

fn count(report: &Report, stage: &str, name: &str) -> f64 {
    report.stages.iter().find(|of| of.name == stage).unwrap().counts[name]
}

#[test]
fn a_run_goes_on_from_its_last_finished_unit_of_work() {
    let folder = tempfile::tempdir().unwrap();
    // 780 pairs: three whole units of matching and a part of one.
    make_scene(folder.path(), 40);
    let options: ReconstructionOptions = serde_json::from_value(
        json!({"intake": {"ready_features": true}, "coarse": {"pairs": {"exhaustive_up_to": 100}}}),
    )
    .unwrap();
    let whole = run(folder.path(), "whole", &options, &quiet()).unwrap();
    assert!(!whole.models.is_empty());
    let expected = models(folder.path(), "whole");
    assert!(expected.keys().any(|path| path.ends_with("points.ply")));
    assert_eq!((count(&whole, "features", "images_reused"), count(&whole, "coarse_match", "pairs_reused")), (0.0, 0.0));
    let pairs = count(&whole, "coarse_match", "pairs_tried");

    let stop = |stage, units| {
        let cancel = CancelFlag::default();
        let sink = Arc::new(StopAt { stage, units, seen: AtomicU64::new(0), cancel: cancel.clone() });
        let context = Context { cancel, progress: Arc::<StopAt>::clone(&sink), ..quiet() };
        let stopped = run(folder.path(), "stopped", &options, &context);
        assert!(matches!(stopped, Err(PipelineError::Cancelled)), "{stopped:?}");
        sink.seen.load(Ordering::SeqCst)
    };
    assert!(stop(Stage::Features, 15) < 40);
    // More than two units, fewer than all.
    let matched = stop(Stage::CoarseMatch, 600) as f64;
    assert!(matched < pairs, "{matched} of {pairs}");
    let after = run(folder.path(), "stopped", &options, &quiet()).unwrap();
    let features = count(&after, "features", "images_reused");
    assert_eq!(features, 40.0, "found before the stage that was stopped");
    let reused = count(&after, "coarse_match", "pairs_reused");
    assert!(reused >= 512.0 && reused <= matched, "{reused} of {matched} pairs");
    assert!(models(folder.path(), "stopped") == expected, "the outputs differ");

    // Other options of a late stage: what they do not touch is not done again.
    let mut other = options.clone();
    other.refine.enabled = !options.refine.enabled;
    let again = run(folder.path(), "stopped", &other, &quiet()).unwrap();
    for stage in &again.stages {
        let touched = ["intake", "features", "refine", "export"].contains(&stage.name.as_str());
        assert!(stage.reused || touched, "{} was done again", stage.name);
    }
    assert_eq!(count(&again, "features", "images_reused"), 40.0);
}
