//! The export stage: every model as COLMAP, Bundler and PLY files, then the reports.

use std::collections::BTreeMap;
use std::io::{self, BufWriter, Write};
use std::path::{Path, PathBuf};

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

/// Writes one model in every format.
fn write_model(out_dir: &Path, rank: usize, model: &Reconstruction, intake: &Intake) -> Result<(), PipelineError> {
    let name = |id: ImageId| intake.name(id);
    let rank = rank.to_string();
    let [sparse, bundle, clouds] = ["sparse", "bundle", "ply"].map(|format| out_dir.join(format).join(&rank));
    write(&sparse.join("cameras.bin"), |out| colmap::write_cameras_bin(model, out))?;
    write(&sparse.join("images.bin"), |out| colmap::write_images_bin(model, name, out))?;
    write(&sparse.join("points3D.bin"), |out| colmap::write_points3d_bin(model, out))?;
    write(&sparse.join("cameras.txt"), |out| colmap::write_cameras_txt(model, out))?;
    write(&sparse.join("images.txt"), |out| colmap::write_images_txt(model, name, out))?;
    write(&sparse.join("points3D.txt"), |out| colmap::write_points3d_txt(model, out))?;
    write(&bundle.join("bundle.out"), |out| bundler::write_bundle(model, out))?;
    write(&bundle.join("list.txt"), |out| bundler::write_list(model, name, out))?;
    write(&clouds.join("points.ply"), |out| ply::write_points(model, out))?;
    write(&clouds.join("cameras.ply"), |out| ply::write_cameras(model, out))
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
fn write(
    path: &PathBuf,
    fill: impl FnOnce(&mut BufWriter<std::fs::File>) -> io::Result<()>,
) -> Result<(), PipelineError> {
    let written = (|| {
        if let Some(folder) = path.parent() {
            std::fs::create_dir_all(folder)?;
        }
        let mut out = BufWriter::new(std::fs::File::create(path)?);
        fill(&mut out)?;
        out.into_inner().map_err(io::IntoInnerError::into_error)?.sync_all()
    })();
    written.map_err(|source| io_error(Stage::Export, path, source))
}
