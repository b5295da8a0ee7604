//! Photographs out of a multipart request, straight to disk.
//!
//! Memory is fixed: the bytes of a part go through a short queue to a blocking writer, which hashes and stores them; files are
//! synced side by side and committed in batches. A sender that stalls is given up, one that disconnects leaves nothing but
//! photographs that sending again finds stored.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::body::Body;
use axum::extract::multipart::{Field, MultipartError};
use axum::extract::{FromRequest, Multipart, Request};
use axum::http::StatusCode;
use bytes::Bytes;
use futures_util::StreamExt;
use tokio::sync::mpsc;
use tokio::task::{JoinHandle, spawn_blocking};
use uuid::Uuid;

use super::AppState;
use super::disposition::file_name;
use super::problem::{Code, Problem};
use super::unread::Unread;
use crate::config::UploadLimits;
use crate::store::{ArchiveError, Committed, ImagePath, ScratchDir, StagedFile, StagedWriter, Store, unpack};

/// Files synced side by side and committed at once.
const BATCH_FILES: usize = 32;
/// Chunks on their way to the writer; a chunk is what one read of the connection brought.
const QUEUED_CHUNKS: usize = 8;
/// Names of left-out files that are told; all are counted.
const TOLD_NAMES: usize = 100;
/// Bytes between two parts, and before the first: the head of a part, and what the reader takes ahead. The reader would
/// keep the head of a part whole, however long.
const MAX_HEAD_BYTES: u64 = 1 << 20;
/// Bytes of the text parts.
const MAX_TEXT_BYTES: usize = 256 << 10;

/// What a request brought.
#[derive(Debug, Default)]
pub(super) struct Received {
    pub(super) stored: usize,
    pub(super) unchanged: usize,
    /// Files left out, and the first of their names.
    pub(super) ignored: usize,
    pub(super) ignored_names: Vec<String>,
    /// The text parts, by their names.
    texts: BTreeMap<&'static str, String>,
}

/// Which parts a form may have besides photographs and archives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Form {
    /// None.
    Photographs,
    /// A job's name, options, priority and webhook.
    Job,
    /// What clients of NodeODM send: archives come among the photographs, and parts that mean nothing here are passed over.
    NodeOdm,
}

impl Form {
    /// Text parts that mean something.
    fn texts(self) -> &'static [&'static str] {
        match self {
            Self::Photographs => &[],
            Self::Job => &["name", "options", "priority", "webhook"],
            Self::NodeOdm => &["name", "options", "webhook", "zipurl"],
        }
    }
}

impl Received {
    /// A text part, where it came and is not empty.
    pub(super) fn text(&self, name: &str) -> Option<&str> {
        self.texts.get(name).map(|text| text.trim()).filter(|text| !text.is_empty())
    }

    /// Whether any file came, of whatever kind.
    pub(super) fn has_files(&self) -> bool {
        self.stored + self.unchanged + self.ignored > 0
    }

    fn ignore(&mut self, name: String) {
        self.ignored += 1;
        if self.ignored_names.len() < TOLD_NAMES {
            self.ignored_names.push(name);
        }
    }
}

/// One request on its way into a dataset.
struct Intake {
    store: Arc<Store>,
    dataset: Uuid,
    limits: UploadLimits,
    idle: Duration,
    /// For files on their way; goes with all it holds when the request ends.
    scratch: ScratchDir,
    received: Received,
    bytes: u64,
    files: usize,
    batch: Vec<JoinHandle<std::io::Result<StagedFile>>>,
}

/// The parts of a request's form, with a limit on what lies between them.
pub(super) struct Parts {
    multipart: Multipart,
    between: Between,
    unread: Unread,
}

/// Bytes the reader took since it began to look for a part; none while it reads one.
type Between = Arc<Mutex<Option<u64>>>;

impl Parts {
    /// # Errors
    /// When the request says that its body is no form.
    pub(super) async fn of(request: Request) -> Result<Self, Problem> {
        let between = Between::default();
        let counted = Arc::clone(&between);
        let (request, body) = request.into_parts();
        let (body, unread) = Unread::split(body);
        let request = Request::from_parts(
            request,
            Body::from_stream(body.into_data_stream().map(move |chunk| {
                let chunk = chunk?;
                let mut taken = counted.lock().unwrap_or_else(PoisonError::into_inner);
                if let Some(taken) = taken.as_mut() {
                    *taken += chunk.len() as u64;
                    if *taken > MAX_HEAD_BYTES {
                        return Err(axum::Error::new("the head of a part is too long"));
                    }
                }
                Ok(chunk)
            })),
        );
        let multipart = Multipart::from_request(request, &())
            .await
            .map_err(|error| Problem::new(Code::InvalidMultipart).detail(error.body_text()))?;
        Ok(Self { multipart, between, unread })
    }

    async fn next(&mut self, idle: Duration) -> Result<Option<Field<'_>>, Problem> {
        let count = |bytes| *self.between.lock().unwrap_or_else(PoisonError::into_inner) = bytes;
        count(Some(0));
        let field = in_time(idle, self.multipart.next_field()).await;
        count(None);
        field
    }
}

/// Stores every photograph of a request in a dataset.
pub(super) async fn receive(state: &AppState, parts: Parts, dataset: Uuid, form: Form) -> Result<Received, Problem> {
    let unread = parts.unread.clone();
    let received = receive_parts(state, parts, dataset, form).await;
    if received.is_err() {
        unread.drop_rest().await;
    }
    received
}

async fn receive_parts(state: &AppState, mut parts: Parts, dataset: Uuid, form: Form) -> Result<Received, Problem> {
    let mut intake = Intake {
        store: Arc::clone(&state.jobs.store),
        dataset,
        limits: state.config.uploads,
        idle: state.config.upload_idle_timeout,
        scratch: state.jobs.store.data.scratch()?,
        received: Received::default(),
        bytes: 0,
        files: 0,
        batch: Vec::new(),
    };
    loop {
        let Some(field) = parts.next(intake.idle).await? else { break };
        let name = field.name().unwrap_or("");
        if let Some(text) = form.texts().iter().find(|text| **text == name) {
            let value = intake.text(field).await?;
            intake.received.texts.insert(text, value);
            continue;
        }
        match name {
            "images" if form == Form::NodeOdm && is_archive(&field) => intake.archive(field).await?,
            "images" => intake.photograph(field).await?,
            "archive" => intake.archive(field).await?,
            _ if form == Form::NodeOdm => intake.pass_over(field).await?,
            other => {
                let message = format!("no part {other:?} is known here");
                return Err(Problem::new(Code::InvalidMultipart).detail(message));
            }
        }
    }
    intake.commit().await?;
    state.metrics.uploaded(intake.bytes, intake.received.stored);
    Ok(intake.received)
}

impl Intake {
    async fn photograph(&mut self, field: Field<'_>) -> Result<(), Problem> {
        let name = file_name(field.headers())?;
        let path = ImagePath::parse(&name).map_err(|why| Problem::file_name(&name, why))?;
        if !path.is_photograph() {
            self.pass_over(field).await?;
            self.received.ignore(name);
            return Ok(());
        }
        self.count_file()?;
        let limit = self.limits.max_file_bytes;
        let writer = self.spool(field, limit).await.map_err(|problem| problem.path(&path))?;
        self.batch.push(spawn_blocking(move || writer.finish(path)));
        if self.batch.len() >= BATCH_FILES {
            self.commit().await?;
        }
        Ok(())
    }

    async fn pass_over(&mut self, mut field: Field<'_>) -> Result<(), Problem> {
        while self.chunk(&mut field).await?.is_some() {}
        Ok(())
    }

    async fn archive(&mut self, field: Field<'_>) -> Result<(), Problem> {
        let limit = self.limits.max_upload_bytes;
        let writer = self.spool(field, limit).await?;
        let archive = ImagePath::parse("archive.zip").map_err(|why| Problem::internal(&why))?;
        let archive =
            spawn_blocking(move || writer.finish(archive)).await.map_err(|panic| Problem::internal(&panic))??;
        let (sender, mut unpacked) = mpsc::channel::<StagedFile>(QUEUED_CHUNKS);
        let (limits, scratch) = (self.limits.archive, self.scratch.path().to_path_buf());
        let unpacking = spawn_blocking(move || {
            unpack(archive.staged_at(), &limits, &scratch, &mut |file| {
                // Nobody takes it any more: the request was refused or broke off.
                sender.blocking_send(file).map_err(|_| ArchiveError::Invalid("the request ended".to_owned()))
            })
        });
        while let Some(file) = unpacked.recv().await {
            self.count_file()?;
            self.batch.push(spawn_blocking(move || Ok(file)));
            if self.batch.len() >= BATCH_FILES {
                self.commit().await?;
            }
        }
        for name in unpacking.await.map_err(|panic| Problem::internal(&panic))?? {
            self.received.ignore(name);
        }
        Ok(())
    }

    /// Writes a part into a temporary file, of at most `limit` bytes.
    async fn spool(&mut self, mut field: Field<'_>, limit: u64) -> Result<StagedWriter, Problem> {
        let (sender, mut chunks) = mpsc::channel::<Bytes>(QUEUED_CHUNKS);
        let scratch = self.scratch.path().to_path_buf();
        let writing = spawn_blocking(move || {
            let mut writer = StagedWriter::create(&scratch)?;
            while let Some(chunk) = chunks.blocking_recv() {
                writer.write(&chunk)?;
            }
            Ok::<_, std::io::Error>(writer)
        });
        let mut size_bytes = 0;
        while let Some(chunk) = self.chunk(&mut field).await? {
            size_bytes += chunk.len() as u64;
            if size_bytes > limit {
                let message = format!("a file has at most {limit} bytes");
                return Err(Problem::new(Code::PayloadTooLarge).detail(message));
            }
            if sender.send(chunk).await.is_err() {
                // The writer ended early: with an error, which the join below brings.
                break;
            }
        }
        drop(sender);
        Ok(writing.await.map_err(|panic| Problem::internal(&panic))??)
    }

    /// A small part as text.
    async fn text(&mut self, mut field: Field<'_>) -> Result<String, Problem> {
        let mut text = Vec::new();
        while let Some(chunk) = self.chunk(&mut field).await? {
            text.extend_from_slice(&chunk);
            if text.len() > MAX_TEXT_BYTES {
                return Err(Problem::new(Code::PayloadTooLarge).detail("a text part is too long"));
            }
        }
        String::from_utf8(text).map_err(|_| Problem::new(Code::InvalidMultipart).detail("a text part is not UTF-8"))
    }

    /// The next bytes of a part, counted.
    async fn chunk(&mut self, field: &mut Field<'_>) -> Result<Option<Bytes>, Problem> {
        let chunk = in_time(self.idle, field.chunk()).await?;
        self.bytes += chunk.as_ref().map_or(0, Bytes::len) as u64;
        if self.bytes > self.limits.max_upload_bytes {
            let message = format!("a request brings at most {} bytes", self.limits.max_upload_bytes);
            return Err(Problem::new(Code::PayloadTooLarge).detail(message));
        }
        Ok(chunk)
    }

    fn count_file(&mut self) -> Result<(), Problem> {
        self.files += 1;
        if self.files > self.limits.max_files {
            let message = format!("a request brings at most {} photographs", self.limits.max_files);
            return Err(Problem::new(Code::TooManyFiles).detail(message));
        }
        Ok(())
    }

    /// Puts the batch into the dataset.
    async fn commit(&mut self) -> Result<(), Problem> {
        let mut files = Vec::with_capacity(self.batch.len());
        for file in self.batch.drain(..) {
            files.push(file.await.map_err(|panic| Problem::internal(&panic))??);
        }
        if files.is_empty() {
            return Ok(());
        }
        let Committed { stored, unchanged } = self.store.commit_images(self.dataset, files).await?;
        self.received.stored += stored;
        self.received.unchanged += unchanged;
        Ok(())
    }
}

/// Whether a file of NodeODM's clients holds photographs; a `seed.zip` holds a project of another program.
fn is_archive(field: &Field<'_>) -> bool {
    let name = file_name(field.headers()).unwrap_or_default().to_ascii_lowercase();
    name.ends_with(".zip") && !name.ends_with("seed.zip")
}

/// Waits for bytes of the sender, but not for ever.
async fn in_time<T>(idle: Duration, read: impl Future<Output = Result<T, MultipartError>>) -> Result<T, Problem> {
    match tokio::time::timeout(idle, read).await {
        Ok(Ok(value)) => Ok(value),
        Ok(Err(error)) if error.status() == StatusCode::PAYLOAD_TOO_LARGE => {
            Err(Problem::new(Code::PayloadTooLarge).detail(error.body_text()))
        }
        Ok(Err(error)) => Err(Problem::new(Code::InvalidMultipart).detail(error.body_text())),
        Err(_) => Err(Problem::new(Code::RequestTimeout).detail("no byte came for too long")),
    }
}
