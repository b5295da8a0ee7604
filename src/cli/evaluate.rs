//! `multistage evaluate MODEL REFERENCE`: how accurate the poses of a model are.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use super::Failure;
use super::model_poses::{self, NamedPoses};
use crate::geometry::{AUC_THRESHOLDS_DEG, PoseAccuracy, Spread, pose_accuracy};

/// Arguments of `evaluate`.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "MODEL and REFERENCE are each a COLMAP model folder, an output folder of `reconstruct`, a bundle.out \
with its list.txt, an NVM file, a poses.txt (image qw qx qy qz cx cy cz) or a folder of *.camera files. Images are joined by \
their names without folder and extension."
)]
pub struct Args {
    /// The model to measure.
    model: PathBuf,
    /// What is taken for true.
    reference: PathBuf,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let read = |path: &Path| model_poses::read(path).map_err(|error| Failure::Input(error.to_string()));
    let (model, reference) = (read(&args.model)?, read(&args.reference)?);
    if reference.len() < 2 {
        return Err(Failure::Input(format!("{}: a reference needs two poses at least", args.reference.display())));
    }
    let (model, reference) = joined(model, reference);
    let accuracy = pose_accuracy(&model, &reference);
    if args.json {
        let json = serde_json::to_string(&accuracy).map_err(|error| Failure::Outside(error.to_string()))?;
        println!("{json}");
    } else {
        print(&accuracy);
    }
    Ok(())
}

/// Both sets under common names: file names without folder and extension, in lower case. Where these are not unique, paths
/// without extension.
fn joined(model: NamedPoses, reference: NamedPoses) -> (NamedPoses, NamedPoses) {
    let stem = |name: &str| {
        let file = name.rsplit(['/', '\\']).next().unwrap_or(name);
        file.rsplit_once('.').map_or(file, |(stem, _)| stem).to_lowercase()
    };
    let path = |name: &str| name.rsplit_once('.').map_or(name, |(stem, _)| stem).to_lowercase();
    let unique = |poses: &NamedPoses| poses.keys().map(|name| stem(name)).collect::<BTreeSet<_>>().len() == poses.len();
    let renamed = |poses: NamedPoses, by_stem: bool| -> BTreeMap<_, _> {
        poses.into_iter().map(|(name, pose)| (if by_stem { stem(&name) } else { path(&name) }, pose)).collect()
    };
    let by_stem = unique(&model) && unique(&reference);
    (renamed(model, by_stem), renamed(reference, by_stem))
}

fn print(accuracy: &PoseAccuracy) {
    let PoseAccuracy { reference_images, registered, extra, aligned, auc_percent } = accuracy;
    println!("registered      {registered} of {reference_images} (and {extra} that the reference lacks)");
    let line = |Spread { mean, median, max }: &Spread| format!("mean {mean:.5}, median {median:.5}, largest {max:.5}");
    match aligned {
        Some(errors) => {
            println!("centre error    {} (units of the reference)", line(&errors.center));
            println!("  relative      mean {:.5} of the mean camera distance", errors.center_mean_relative);
            println!("rotation error  {} (degrees)", line(&errors.rotation_deg));
        }
        None => println!("centre error    none: the common images do not fix an alignment"),
    }
    for (threshold, auc) in AUC_THRESHOLDS_DEG.iter().zip(auc_percent.iter().flatten()) {
        println!("AUC@{threshold:<2} deg      {auc:.2}");
    }
}
