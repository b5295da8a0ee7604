//! The whole pipeline: the order of the stages, and what each is keyed by.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use super::add_points::PointAdder;
use super::features::{self, FeatureCache, ImageFeatures, StoredFeatures};
use super::intake::{self, Intake};
use super::localise::Localiser;
use super::measure::Stopwatch;
use super::options::ReconstructionOptions;
use super::runner::{ArtifactKey, Counts, Runner, counts};
use super::state::{ModelState, PipelineState};
use super::units::Units;
use super::{Context, PipelineError, ProgressEvent, Stage, StageKey, coarse, export, refine, report};
use crate::coarse::Unregistered;
use crate::coarse::look_alikes::CutPair;
use crate::formats::report::Report;
use crate::scene::{ImageId, world_frame};

/// The folders of a run.
#[derive(Clone, Debug)]
pub struct RunPaths {
    /// The photographs, in sub-folders or not.
    pub images_dir: PathBuf,
    /// Where the outputs go.
    pub out_dir: PathBuf,
    /// Where stage results are kept for resuming.
    pub work_dir: PathBuf,
}

/// Bytes of features kept in memory at most while cameras are added; more are read back from disk when needed. Measured
/// on 128 images of 17,000 features: 64 MiB take no more CPU time than 768, and 194 MB less at the peak.
pub(super) const FEATURE_CACHE_BYTES: usize = 64 << 20;

/// Runs the pipeline on its own pool of `context.threads` threads and writes every output. That no model was found is not an
/// error: the report says why.
///
/// # Errors
/// Invalid options, an unusable input folder, cancellation, or files that can't be read or written.
pub fn reconstruct(
    paths: &RunPaths,
    options: &ReconstructionOptions,
    context: &Context,
) -> Result<Report, PipelineError> {
    options.validate()?;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(context.threads.max(1))
        .thread_name(|at| format!("pipeline-{at}"))
        .build()
        .map_err(|error| PipelineError::InvalidOptions(vec![format!("threads: {error}")]))?;
    pool.install(|| Pipeline { paths, options, context }.run())
}

struct Pipeline<'a> {
    paths: &'a RunPaths,
    options: &'a ReconstructionOptions,
    context: &'a Context,
}

impl Pipeline<'_> {
    fn run(&self) -> Result<Report, PipelineError> {
        let watch = Stopwatch::start();
        let (options, context) = (self.options, self.context);
        context.progress.report(ProgressEvent::Plan(self.plan()));
        let mut runner = Runner::new(&self.paths.work_dir, context)?;

        let intake: Intake = runner.stage(key(Stage::Intake), None, 0, |_, _| {
            let intake = intake::run(&self.paths.images_dir, &options.intake, context)?;
            let usable = intake.photographs().count();
            let totals =
                counts([("files", intake.files.len()), ("photographs", usable), ("cameras", intake.cameras.len())]);
            Ok((intake, totals))
        })?;
        let names_and_hashes: Vec<_> = intake.files.iter().map(|file| (&file.name, &file.sha256)).collect();
        let input_key =
            ArtifactKey::of("input", &[&names_and_hashes, &options.intake, &options.features, &context.seed]);

        let usable = intake.photographs().count() as u64;
        let found: BTreeMap<ImageId, ImageFeatures> =
            runner.stage(key(Stage::Features), None, usable, |store, progress| {
                features::run(&self.paths.images_dir, &intake, options, context, store, progress)
            })?;

        let mut notes = Vec::new();
        let mut models_key = ArtifactKey::of("coarse", &[&input_key.0, &options.coarse]);
        let coarse = coarse::run(&mut runner, &intake, &found, options, &models_key, &mut notes)?;
        let coarse::Coarse { mut state, match_counts, rotations, cameras, cut } = coarse;

        let mut placed_before: Option<BTreeSet<ImageId>> = None;
        for iteration in 1..=options.iterations {
            let stage = StageKey { stage: Stage::AddCameras, iteration: Some(iteration) };
            models_key = ArtifactKey::of("add_cameras", &[&models_key.0, &iteration, &options.add_cameras]);
            let waiting = (found.len() - state.located().len()) as u64;
            let before = state;
            state = runner.stage(stage, Some(&models_key), waiting, |store, progress| {
                let cache = FeatureCache::new(StoredFeatures::new(store, &found), FEATURE_CACHE_BYTES);
                let units = Units::new(store, Stage::AddCameras, &models_key);
                let localiser = Localiser {
                    intake: &intake,
                    found: &found,
                    cameras: &cameras,
                    match_counts: &match_counts,
                    rotations: &rotations,
                    cache: &cache,
                    units: &units,
                    options,
                    context,
                };
                let (mut state, totals) = localiser.run(before, progress)?;
                state.record(stage);
                Ok((state, totals))
            })?;

            let stage = StageKey { stage: Stage::AddPoints, iteration: Some(iteration) };
            let placed: BTreeSet<ImageId> = state.located().into_keys().collect();
            let newly =
                placed_before.as_ref().map(|before| placed.difference(before).copied().collect::<BTreeSet<_>>());
            models_key = ArtifactKey::of("add_points", &[&models_key.0, &iteration, &options.add_points]);
            let before = state;
            state = runner.stage(stage, Some(&models_key), 0, |store, progress| {
                let features = StoredFeatures::new(store, &found);
                let units = Units::new(store, Stage::AddPoints, &models_key);
                let adder = PointAdder { features: &features, units: &units, options: &options.add_points, context };
                let mut state = before;
                let mut totals = Counts::new();
                for (rank, ModelState { model, unconfirmed, .. }) in state.models.iter_mut().enumerate() {
                    let here = |id: &ImageId| model.image(*id).is_some();
                    let newly: Option<BTreeSet<ImageId>> =
                        newly.as_ref().map(|newly| newly.iter().copied().filter(here).collect());
                    let (counts, more) = adder.run(rank, model, newly.as_ref(), progress)?;
                    unconfirmed.extend(more);
                    for (name, count) in counts {
                        *totals.entry(name).or_insert(0.0) += count;
                    }
                }
                state.record(stage);
                Ok((state, totals))
            })?;
            placed_before = Some(placed);
        }

        if options.refine.enabled {
            models_key = ArtifactKey::of("refine", &[&models_key.0, &options.refine]);
            let before = state;
            state = runner.stage(
                key(Stage::Refine),
                Some(&models_key),
                before.models.len() as u64,
                |store, progress| {
                    let features = StoredFeatures::new(store, &found);
                    let mut state = before;
                    let points_before: usize = state.models.iter().map(|account| account.model.num_points()).sum();
                    let mut completed = 0;
                    for account in &mut state.models {
                        completed += refine::refine(account, &features, options, context)?;
                        progress.tick();
                    }
                    let points: usize = state.models.iter().map(|account| account.model.num_points()).sum();
                    state.record(key(Stage::Refine));
                    let totals =
                        [("points_before", points_before), ("points_completed", completed), ("points", points)];
                    Ok((state, counts(totals)))
                },
            )?;
        }

        self.finish(runner, watch, &intake, &found, state, (notes, &cut))
    }

    /// The stages ahead.
    fn plan(&self) -> Vec<StageKey> {
        let mut plan: Vec<StageKey> =
            [Stage::Intake, Stage::Features, Stage::CoarseMatch, Stage::CoarseModel].map(key).to_vec();
        for iteration in 1..=self.options.iterations {
            for stage in [Stage::AddCameras, Stage::AddPoints] {
                plan.push(StageKey { stage, iteration: Some(iteration) });
            }
        }
        if self.options.refine.enabled {
            plan.push(key(Stage::Refine));
        }
        plan.push(key(Stage::Export));
        plan
    }

    /// Levels the models, writes every output and the report.
    fn finish(
        &self,
        mut runner: Runner<'_>,
        watch: Stopwatch,
        intake: &Intake,
        found: &BTreeMap<ImageId, ImageFeatures>,
        mut state: PipelineState,
        (mut notes, cut): (Vec<String>, &[CutPair]),
    ) -> Result<Report, PipelineError> {
        let orientation: BTreeMap<ImageId, u8> =
            intake.photographs().filter_map(|(id, _, photograph)| Some((id, photograph.exif.orientation?))).collect();
        for account in &mut state.models {
            world_frame::level(&mut account.model, &orientation);
        }
        state
            .models
            .sort_by_key(|account| std::cmp::Reverse((account.model.images().len(), account.model.num_points())));
        for (id, _, _) in intake.photographs() {
            state.unregistered.entry(id).or_insert(Unregistered::NoPairs);
        }
        let images = found.len() as u64;
        let (state, thumbnails) = {
            let mut thumbnails = BTreeMap::new();
            let mut exported = None;
            runner.stage(key(Stage::Export), None, images, |store, progress| {
                let (state, made) = export::run(self.paths, intake, found, store, state, self.context, progress)?;
                thumbnails = made;
                let models = state.models.len();
                exported = Some(state);
                Ok(((), counts([("models", models)])))
            })?;
            (exported.unwrap_or_default(), thumbnails)
        };
        notes.extend(report::focal_notes(&state.models, &self.options.coarse.focals.voting));
        notes.extend(report::principal_point_notes(&state.models));
        let report =
            report::build(self.options, self.context, intake, found, &state, runner.stages, notes, cut, &watch);
        export::write_reports(self.paths, &report, &state, intake, &thumbnails)?;
        Ok(report)
    }
}

/// A stage that runs once.
pub(super) fn key(stage: Stage) -> StageKey {
    StageKey { stage, iteration: None }
}
