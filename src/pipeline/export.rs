//! The export stage: every model as COLMAP, Bundler and PLY files, then the reports.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

use rayon::prelude::*;

use super::colors::{self, Thumbnails};
use super::features::ImageFeatures;
use super::intake::Intake;
use super::run::RunPaths;
use super::runner::{StageProgress, io_error};
use super::state::PipelineState;
use super::{Context, PipelineError, Stage};
use crate::formats::report::Report;
use crate::formats::{bundler, colmap, ply, report_html};
use crate::scene::{ImageId, Reconstruction};
use crate::store::ArtifactStore;

/// Colours the points and writes the models. Returns them, coloured, with the thumbnails for the report.
pub fn run(
    paths: &RunPaths,
    intake: &Intake,
    found: &BTreeMap<ImageId, ImageFeatures>,
    store: &ArtifactStore,
    mut state: PipelineState,
    context: &Context,
    progress: &StageProgress<'_>,
) -> Result<(PipelineState, Thumbnails), PipelineError> {
    let thumbnails = colors::run(store, found, &mut state, context, progress)?;
    for folder in ["sparse", "bundle", "ply"] {
        let folder = paths.out_dir.join(folder);
        match std::fs::remove_dir_all(&folder) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => {
                return Err(io_error(Stage::Export, &folder, error));
            }
            _ => {}
        }
    }
    for (rank, account) in state.models.iter().enumerate() {
        context.check_cancelled()?;
        write_model(&paths.out_dir, rank, &account.model, intake)?;
    }
    Ok((state, thumbnails))
}

/// Writes what a file holds.
type Fill<'a> = Box<dyn Fn(&mut BufWriter<File>) -> io::Result<()> + Sync + 'a>;

/// Writes one model in every format, several files at a time: to print numbers takes longer than to write them.
fn write_model(out_dir: &Path, rank: usize, model: &Reconstruction, intake: &Intake) -> Result<(), PipelineError> {
    let name = |id: ImageId| intake.name(id);
    let rank = rank.to_string();
    let [sparse, bundle, clouds] = ["sparse", "bundle", "ply"].map(|format| out_dir.join(format).join(&rank));
    // The longest first.
    let files: [(PathBuf, Fill<'_>); 10] = [
        (sparse.join("images.txt"), Box::new(|out| colmap::write_images_txt(model, name, out))),
        (sparse.join("points3D.txt"), Box::new(|out| colmap::write_points3d_txt(model, out))),
        (bundle.join("bundle.out"), Box::new(|out| bundler::write_bundle(model, out))),
        (sparse.join("points3D.bin"), Box::new(|out| colmap::write_points3d_bin(model, out))),
        (sparse.join("images.bin"), Box::new(|out| colmap::write_images_bin(model, name, out))),
        (clouds.join("points.ply"), Box::new(|out| ply::write_points(model, out))),
        (clouds.join("cameras.ply"), Box::new(|out| ply::write_cameras(model, out))),
        (sparse.join("cameras.bin"), Box::new(|out| colmap::write_cameras_bin(model, out))),
        (sparse.join("cameras.txt"), Box::new(|out| colmap::write_cameras_txt(model, out))),
        (bundle.join("list.txt"), Box::new(|out| bundler::write_list(model, name, out))),
    ];
    let written: Vec<_> = files.par_iter().with_max_len(1).map(|(path, fill)| write(path, fill)).collect();
    written.into_iter().collect()
}

/// Writes `report.json` and `report.html`.
pub fn write_reports(
    paths: &RunPaths,
    report: &Report,
    state: &PipelineState,
    intake: &Intake,
    thumbnails: &Thumbnails,
) -> Result<(), PipelineError> {
    write(&paths.out_dir.join("report.json"), |out| {
        serde_json::to_writer_pretty(&mut *out, report)?;
        out.write_all(b"\n")
    })?;
    let models: Vec<&Reconstruction> = state.models.iter().map(|account| &account.model).collect();
    let named = thumbnails.iter().map(|(&id, jpeg)| (intake.name(id).to_owned(), jpeg.clone())).collect();
    write(&paths.out_dir.join("report.html"), |out| report_html::write(report, &models, &named, out))
}

/// Writes a file through a buffer, making its folder.
fn write(path: &PathBuf, fill: impl FnOnce(&mut BufWriter<File>) -> io::Result<()>) -> Result<(), PipelineError> {
    let written = (|| {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        let mut out = BufWriter::new(File::create(path)?);
        fill(&mut out)?;
        out.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()
    })();
    written.map_err(|source| io_error(Stage::Export, path, source))
}
