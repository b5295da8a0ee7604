//! Which job comes next, and when: priorities, turns between tokens, and a forecast for those that wait.
//!
//! Higher priority goes first. Among equals the token with the fewest running jobs has the turn, then the one whose last turn
//! is longest ago; its own jobs go in the order they came. So a token that queues a hundred jobs delays another's single one
//! by one job at most.

use std::cmp::Reverse;
use std::collections::{BTreeMap, VecDeque};

use serde::Serialize;

use super::eta::Eta;
use super::resources::Hold;

/// By what factor a run may be off from what the rates of other runs say.
const RATE_SPREAD: f64 = 1.5;

/// A job in the queue.
#[derive(Clone, Debug, PartialEq)]
pub struct Waiting {
    /// Its id, a UUID in text.
    pub id: String,
    /// The token it belongs to.
    pub owner: Option<String>,
    /// Higher goes first.
    pub priority: i64,
    /// Place in the order of making.
    pub seq: i64,
    /// How much there is to do.
    pub size: Size,
    /// What it waits for besides its turn.
    pub held: Option<Hold>,
}

/// What the time of a run goes by.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Size {
    /// Photographs.
    pub images: f64,
    /// Their bytes.
    pub bytes: f64,
}

/// What a token has had so far.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Turns {
    /// Its jobs that run.
    pub running: usize,
    /// When its latest job started.
    pub last_ms: Option<i64>,
}

/// The order in which waiting jobs start, as far as can be said now.
pub fn order(waiting: Vec<Waiting>, turns: &BTreeMap<Option<String>, Turns>) -> Vec<Waiting> {
    let mut by_priority: BTreeMap<Reverse<i64>, BTreeMap<Option<String>, VecDeque<Waiting>>> = BTreeMap::new();
    let mut sorted = waiting;
    sorted.sort_by_key(|job| job.seq);
    for job in sorted {
        let queues = by_priority.entry(Reverse(job.priority)).or_default();
        queues.entry(job.owner.clone()).or_default().push_back(job);
    }
    // Turns count on behind those that were: no time in the past is as late.
    let mut shares: BTreeMap<Option<String>, (usize, (bool, i64))> = turns
        .iter()
        .map(|(owner, turns)| (owner.clone(), (turns.running, (false, turns.last_ms.unwrap_or(i64::MIN)))))
        .collect();
    let mut ordered = Vec::new();
    for mut queues in by_priority.into_values() {
        while let Some(owner) = queues
            .iter()
            .min_by_key(|(owner, jobs)| {
                let share = shares.get(*owner).copied().unwrap_or((0, (false, i64::MIN)));
                (share, jobs.front().map(|job| job.seq))
            })
            .map(|(owner, _)| owner.clone())
        {
            let Some(jobs) = queues.get_mut(&owner) else { break };
            ordered.extend(jobs.pop_front());
            if jobs.is_empty() {
                queues.remove(&owner);
            }
            let share = shares.entry(owner).or_insert((0, (false, 0)));
            *share = (share.0 + 1, (true, i64::try_from(ordered.len()).unwrap_or(i64::MAX)));
        }
    }
    ordered
}

/// Seconds that runs took for what they had to do: those measured on this machine lately.
#[derive(Clone, Debug, Default)]
pub struct Rates {
    per_image_s: Option<Eta>,
    per_byte_s: Option<Eta>,
}

impl Rates {
    /// Takes a run into account: what it had to do, and the seconds it took or is thought to take.
    pub fn add(&mut self, size: Size, seconds: Eta) {
        let widen = |rate: &mut Option<Eta>, amount: f64| {
            if amount > 0.0 && seconds.low > 0.0 {
                let (low, high) = (seconds.low / amount, seconds.high / amount);
                let known = rate.unwrap_or(Eta { low, high });
                *rate = Some(Eta { low: known.low.min(low), high: known.high.max(high) });
            }
        };
        widen(&mut self.per_image_s, size.images);
        widen(&mut self.per_byte_s, size.bytes);
    }

    /// How long a run will take, from the quickest to the slowest that the measured ones make likely; none without any.
    pub fn forecast(&self, size: Size) -> Option<Eta> {
        let (image, byte) = (self.per_image_s?, self.per_byte_s?);
        Some(Eta {
            low: (image.low * size.images).min(byte.low * size.bytes) / RATE_SPREAD,
            high: (image.high * size.images).max(byte.high * size.bytes) * RATE_SPREAD,
        })
    }
}

/// Where a waiting job stands.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct QueuePlace {
    /// 1 for the job that starts next.
    pub position: usize,
    /// Seconds until it starts; none when a run ahead can't be told.
    pub starts_in_s: Option<Eta>,
    /// What it waits for besides its turn: `disk_full` or `memory`.
    pub held: Option<Hold>,
    /// Seconds until it is done.
    #[serde(skip)]
    pub done_in_s: Option<Eta>,
}

/// The places of jobs in their order, on `lanes` lanes of which some are busy for the time that `running` says.
pub fn places(ordered: &[Waiting], lanes: usize, running: &[Option<Eta>], rates: &Rates) -> Vec<QueuePlace> {
    let mut free: Vec<Option<Eta>> = running.to_vec();
    free.resize(lanes.max(running.len()).max(1), Some(Eta { low: 0.0, high: 0.0 }));
    // The lane that is free first, of those that can be told: low and high times each for themselves.
    let first = |free: &[Option<Eta>], time: fn(&Eta) -> f64| {
        let known = free.iter().enumerate().filter_map(|(lane, eta)| Some((lane, time(eta.as_ref()?))));
        known.min_by(|a, b| a.1.total_cmp(&b.1))
    };
    let (mut free_low, mut free_high) = (free.clone(), free);
    let mut places = Vec::with_capacity(ordered.len());
    for (at, job) in ordered.iter().enumerate() {
        let run = rates.forecast(job.size);
        let low = first(&free_low, |eta| eta.low);
        let high = first(&free_high, |eta| eta.high);
        // When space or memory returns, nobody knows.
        let (low, high) = if job.held.is_some() { (None, None) } else { (low, high) };
        let starts_in_s = low.zip(high).map(|(low, high)| Eta { low: low.1.min(high.1), high: high.1 });
        let done_in_s = starts_in_s.zip(run).map(|(start, run)| start.plus(run));
        if let Some((lane, _)) = low {
            free_low[lane] = free_low[lane].zip(run).map(|(free, run)| free.plus(run));
        }
        if let Some((lane, _)) = high {
            free_high[lane] = free_high[lane].zip(run).map(|(free, run)| free.plus(run));
        }
        places.push(QueuePlace { position: at + 1, starts_in_s, held: job.held, done_in_s });
    }
    places
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn job(id: &str, priority: i64, seq: i64) -> Waiting {
        let owner = (!id.starts_with('-')).then(|| id[..1].to_owned());
        Waiting { id: id.to_owned(), owner, priority, seq, size: Size { images: 10.0, bytes: 1e6 }, held: None }
    }

    fn ids(ordered: &[Waiting]) -> Vec<&str> {
        ordered.iter().map(|job| job.id.as_str()).collect()
    }

    #[test]
    fn tokens_take_turns_within_a_priority() {
        let waiting = vec![
            job("a1", 0, 1),
            job("a2", 0, 2),
            job("a3", 0, 3),
            job("b1", 0, 4),
            job("b2", 0, 5),
            job("c1", -1, 6),
            job("a4", 5, 7),
            job("-1", 0, 8),
        ];
        let none = BTreeMap::new();
        assert_eq!(ids(&order(waiting.clone(), &none)), ["a4", "b1", "-1", "a1", "b2", "a2", "a3", "c1"]);
        // b had the latest turn, and a's is longer ago.
        let last = |last_ms| Turns { running: 0, last_ms: Some(last_ms) };
        let turns = BTreeMap::from([(Some("b".to_owned()), last(9)), (Some("a".to_owned()), last(5))]);
        assert_eq!(ids(&order(waiting[..5].to_vec(), &turns)), ["a1", "b1", "a2", "b2", "a3"]);
        let busy = BTreeMap::from([(Some("a".to_owned()), Turns { running: 1, last_ms: Some(1) })]);
        assert_eq!(ids(&order(waiting[..5].to_vec(), &busy))[0], "b1", "a has one running already");
    }

    #[test]
    fn nobody_waits_for_more_than_one_job_of_each_other_token() {
        let mut waiting: Vec<_> = (0..100).map(|seq| job("a", 0, seq)).collect();
        waiting.push(job("b", 0, 100));
        let at = order(waiting, &BTreeMap::new()).iter().position(|job| job.id == "b").unwrap();
        assert!(at <= 1, "{at}");
    }

    #[test]
    fn places_bracket_what_the_rates_say() {
        let mut rates = Rates::default();
        assert_eq!(rates.forecast(Size { images: 1.0, bytes: 1.0 }), None);
        rates.add(Size { images: 20.0, bytes: 4e6 }, Eta { low: 40.0, high: 40.0 });
        rates.add(Size { images: 10.0, bytes: 1e6 }, Eta { low: 25.0, high: 30.0 });
        let run = rates.forecast(Size { images: 10.0, bytes: 1e6 }).unwrap();
        assert!(run.low < 20.0 && run.high > 30.0 && run.high < 8.0 * run.low, "{run:?}");
        let jobs = [job("a1", 0, 1), job("a2", 0, 2), job("a3", 0, 3)];
        let running = [Some(Eta { low: 50.0, high: 60.0 })];
        let places = places(&jobs, 2, &running, &rates);
        assert_eq!(places.iter().map(|place| place.position).collect::<Vec<_>>(), [1, 2, 3]);
        assert_eq!(places[0].starts_in_s, Some(Eta { low: 0.0, high: 0.0 }), "a lane is free");
        let (second, third) = (places[1].starts_in_s.unwrap(), places[2].starts_in_s.unwrap());
        assert!(second.low == run.low && second.high == run.high.min(60.0), "{second:?}");
        assert!(third.low >= second.low && third.high >= second.high && third.high >= third.low, "{third:?}");
        assert!(places.iter().all(|place| place.done_in_s.unwrap().low > place.starts_in_s.unwrap().low));
    }

    #[test]
    fn what_is_not_known_is_not_said() {
        let jobs = [job("a1", 0, 1), job("a2", 0, 2)];
        let unknown = places(&jobs, 1, &[None], &Rates::default());
        assert!(unknown.iter().all(|place| place.starts_in_s.is_none() && place.done_in_s.is_none()));
        let free = places(&jobs, 1, &[], &Rates::default());
        assert!(free[0].starts_in_s.is_some() && free[1].starts_in_s.is_none());
    }
}
