//! Progress of a run on the terminal: a bar for the stage at work, and a line for each finished one. Without a terminal,
//! the lines alone.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::sync::PoisonError;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressStyle};

use crate::pipeline::{ProgressEvent, ProgressSink, StageKey};

/// Shows progress on standard error.
pub struct TerminalProgress {
    quiet: bool,
    state: Mutex<State>,
}

#[derive(Default)]
struct State {
    planned: usize,
    finished: usize,
    bar: Option<ProgressBar>,
}

impl TerminalProgress {
    /// With `quiet`, shows nothing.
    pub fn new(quiet: bool) -> Self {
        Self { quiet, state: Mutex::default() }
    }
}

impl ProgressSink for TerminalProgress {
    fn report(&self, event: ProgressEvent) {
        if self.quiet {
            return;
        }
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        match event {
            ProgressEvent::Plan(stages) => state.planned = stages.len(),
            ProgressEvent::StageStarted { stage, total } => state.start(stage, total),
            ProgressEvent::StageProgress { done, total, .. } => {
                if let Some(bar) = &state.bar {
                    bar.set_length(total);
                    bar.set_position(done);
                }
            }
            ProgressEvent::StageFinished { stage, reused, wall_s, counts, .. } => {
                state.finish(&line(stage, reused, wall_s, &counts));
            }
        }
    }
}

impl State {
    fn start(&mut self, stage: StageKey, total: u64) {
        let place = format!("[{}/{}]", self.finished + 1, self.planned.max(self.finished + 1));
        let template = if total == 0 {
            "{prefix} {msg:18} {spinner} {elapsed}"
        } else {
            "{prefix} {msg:18} [{bar:32}] {pos}/{len} {elapsed}"
        };
        let style = ProgressStyle::with_template(template).expect("the template is well formed").progress_chars("=> ");
        let bar = ProgressBar::new(total).with_style(style).with_prefix(place).with_message(stage.to_string());
        bar.enable_steady_tick(Duration::from_millis(200));
        self.bar = Some(bar);
    }

    fn finish(&mut self, line: &str) {
        self.finished += 1;
        if let Some(bar) = self.bar.take() {
            bar.finish_and_clear();
        }
        eprintln!("{line}");
    }
}

/// `features             12.3 s   images 25, features 310021`
fn line(stage: StageKey, reused: bool, wall_s: f64, counts: &BTreeMap<String, f64>) -> String {
    let time = if reused { "kept from before".to_owned() } else { format!("{wall_s:.1} s") };
    let counts: Vec<String> =
        counts.iter().map(|(name, count)| format!("{} {count}", name.replace('_', " "))).collect();
    format!("{:18} {time:>10}   {}", stage.to_string(), counts.join(", "))
}
