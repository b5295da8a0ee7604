//! A run that is stopped in the middle of a stage, by a cancel or by SIGKILL, goes on from its last finished units of
//! work: what was done is not done again, by count, and the outputs are, byte for byte, those of a run that nobody
//! stopped, whatever the number of threads of each of its lives.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use multistage::formats::report::Report;
use multistage::pipeline::{
    CancelFlag, Context, NoProgress, PipelineError, ProgressEvent, ProgressSink, ReconstructionOptions, RunPaths,
    Stage, reconstruct,
};
use serde_json::{Value, json};

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
    let spec = json!({"scene": "features", "layout": "street", "num_images": images, "num_points": 15000,
                      "pixel_noise_px": 0.3, "descriptor_noise": 0.2});
    std::fs::write(folder.join("spec.json"), spec.to_string()).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_multistage"));
    let made = command.arg("synthesize").arg(folder.join("spec.json")).arg("--out").arg(folder.join("scene"));
    assert!(made.output().unwrap().status.success());
}

/// Options with which a few features make the coarse model, so that most of the work is left to the later stages.
/// Photographs that see less than `min_pose_inliers` of its points are not in it.
fn options(min_pose_inliers: usize) -> Value {
    let mapper = json!({"min_pose_inliers": min_pose_inliers, "min_pose_inliers_relaxed": min_pose_inliers});
    let selection = json!({"eta_percent": 1, "all_below": 0, "min_features": 300});
    let pairs = json!({"exhaustive_up_to": 100});
    let coarse = json!({"mapper": mapper, "selection": selection, "pairs": pairs, "enough_registered": 0.01});
    json!({"intake": {"ready_features": true}, "coarse": coarse})
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

/// What a run would keep of unfinished stages.
fn unfinished(folder: &Path, name: &str) -> Vec<String> {
    let entries = std::fs::read_dir(folder.join(name).join("work")).unwrap();
    let names = entries.map(|entry| entry.unwrap().file_name().into_string().unwrap());
    names.filter(|name| name.ends_with(".units")).collect()
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
    let options: ReconstructionOptions = serde_json::from_value(options(15)).unwrap();
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
    let pairs = count(&whole, "add_points", "pairs_tried");
    assert!(pairs > 128.0, "too few pairs for several units of work");
    let guided = stop(Stage::AddPoints, (0.7 * pairs) as u64) as f64;
    assert_eq!(unfinished(folder.path(), "stopped").len(), 1, "those of the stage that was stopped");
    let after = run(folder.path(), "stopped", &options, &quiet()).unwrap();
    assert_eq!(unfinished(folder.path(), "stopped"), [""; 0], "what a finished stage had kept is gone");
    let features = count(&after, "features", "images_reused");
    assert_eq!(features, 40.0, "found before the stage that was stopped");
    let reused = count(&after, "add_points", "pairs_reused");
    assert!(reused >= 32.0 && reused <= guided && guided < pairs, "{reused} of {guided} of {pairs} pairs");
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

/// A life of the real program on the scene.
fn start(folder: &Path, name: &str, threads: usize) -> Child {
    let mut command = Command::new(env!("CARGO_BIN_EXE_multistage"));
    command.arg("reconstruct").arg(folder.join("scene/features"));
    for (argument, value) in [("--out", "out"), ("--work-dir", "work")] {
        command.arg(argument).arg(folder.join(name).join(value));
    }
    command.args(["--quiet", "--seed", "3", "--threads", &threads.to_string(), "--options"]);
    command.arg(folder.join("options.json")).spawn().unwrap()
}

/// Finished units of a stage that are stored now.
fn stored_units(work: &Path, stage: &str) -> usize {
    let Ok(entries) = std::fs::read_dir(work) else { return 0 };
    let paths: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    let of_stage = |path: &&PathBuf| path.file_name().unwrap().to_str().unwrap().starts_with(&format!("{stage}-"));
    let of_stage = paths.iter().filter(of_stage);
    if stage == "features" {
        return of_stage.count();
    }
    // A folder may be removed while it is read.
    of_stage
        .filter(|path| path.extension().is_some())
        .filter_map(|path| Some(std::fs::read_dir(path).ok()?.count()))
        .sum()
}

#[test]
fn a_killed_process_goes_on_from_its_finished_units() {
    let folder = tempfile::tempdir().unwrap();
    make_scene(folder.path(), 40);
    std::fs::write(folder.path().join("options.json"), options(155).to_string()).unwrap();
    assert!(start(folder.path(), "whole", 1).wait().unwrap().success());
    let expected = models(folder.path(), "whole");

    let kills = [("features", 7), ("coarse_match", 1), ("coarse_model", 1), ("add_cameras", 1), ("add_points", 1)];
    for (threads, (stage, units)) in [1, 3, 2, 1, 4].into_iter().zip(kills) {
        let work = folder.path().join("killed/work");
        let mut life = start(folder.path(), "killed", threads);
        while stored_units(&work, stage) < units {
            assert!(life.try_wait().unwrap().is_none(), "over before {stage} had {units} units");
            std::thread::sleep(Duration::from_micros(200));
        }
        life.kill().unwrap();
        life.wait().unwrap();
    }
    assert!(start(folder.path(), "killed", 2).wait().unwrap().success());
    let report = std::fs::read(folder.path().join("killed/out/report.json")).unwrap();
    let report: Report = serde_json::from_slice(&report).unwrap();
    let units = [
        ("coarse_match", "pairs_tried", "pairs_reused"),
        ("coarse_model", "images", "images_reused"),
        ("add_cameras", "images_tried", "images_reused"),
        ("add_points", "pairs_tried", "pairs_reused"),
    ];
    for (stage, all, reused) in units {
        let first = report.stages.iter().find(|of| of.name == stage).unwrap();
        let (tried, reused) = (first.counts[all], first.counts[reused]);
        println!("{stage} went on from {reused} of {tried}");
        // Units end in any order, and the last is smaller; the kill may have come so late that the whole stage was stored.
        assert!(reused > 0.0 || first.reused, "{stage}: {reused} of {tried}");
    }
    assert_eq!(unfinished(folder.path(), "killed"), [""; 0]);
    assert!(models(folder.path(), "killed") == expected, "the outputs differ");
}
