//! How many requests a token may send, and how many wrong tokens an address.

use std::collections::HashMap;
use std::hash::Hash;
use std::net::IpAddr;
use std::sync::{Mutex, PoisonError};
use std::time::Instant;

/// Entries a table may have before those that are full again are left out.
const PRUNE_ABOVE: usize = 10_000;

/// A bucket that fills steadily and that every request takes from.
#[derive(Clone, Copy, Debug)]
struct Bucket {
    left: f64,
    at: Instant,
}

/// Buckets by key, all of one size.
#[derive(Debug)]
struct Buckets<K> {
    size: f64,
    per_s: f64,
    buckets: Mutex<HashMap<K, Bucket>>,
}

impl<K: Hash + Eq> Buckets<K> {
    fn new(size: f64, per_s: f64) -> Self {
        Self { size, per_s, buckets: Mutex::default() }
    }

    /// Takes `cost`; the seconds to wait when there is not enough.
    fn take(&self, key: K, cost: f64, now: Instant) -> Option<u64> {
        // A panic elsewhere can't leave the map half changed.
        let mut buckets = self.buckets.lock().unwrap_or_else(PoisonError::into_inner);
        let filled = |bucket: &Bucket| {
            (bucket.left + now.saturating_duration_since(bucket.at).as_secs_f64() * self.per_s).min(self.size)
        };
        if buckets.len() > PRUNE_ABOVE {
            buckets.retain(|_, bucket| filled(bucket) < self.size);
        }
        let bucket = buckets.entry(key).or_insert(Bucket { left: self.size, at: now });
        let left = filled(bucket);
        if left < cost.max(1.0) {
            return Some(((1.0 - left) / self.per_s).ceil().max(1.0) as u64);
        }
        *bucket = Bucket { left: left - cost, at: now };
        None
    }
}

/// The limits of a process.
#[derive(Debug)]
pub struct RateLimits {
    tokens: Buckets<String>,
    failures: Buckets<IpAddr>,
}

impl RateLimits {
    /// `requests_per_s` of one token, with bursts of ten seconds' worth; `failures_per_min` wrong tokens of one address.
    pub fn new(requests_per_s: u32, failures_per_min: u32) -> Self {
        let (requests, failures) = (f64::from(requests_per_s.max(1)), f64::from(failures_per_min.max(1)));
        Self { tokens: Buckets::new(10.0 * requests, requests), failures: Buckets::new(failures, failures / 60.0) }
    }

    /// A request of a token; the seconds to wait when there were too many.
    pub(super) fn spend(&self, token: &str) -> Option<u64> {
        self.tokens.take(token.to_owned(), 1.0, Instant::now())
    }

    /// A wrong token came from an address.
    pub(super) fn failed(&self, address: IpAddr) {
        self.failures.take(address, 1.0, Instant::now());
    }

    /// How long an address that guessed too often must wait.
    pub(super) fn blocked_for_s(&self, address: IpAddr) -> Option<u64> {
        self.failures.take(address, 0.0, Instant::now())
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[test]
    fn a_bucket_empties_and_fills_again() {
        let buckets = Buckets::new(3.0, 0.5);
        let start = Instant::now();
        for _ in 0..3 {
            assert_eq!(buckets.take("a", 1.0, start), None);
        }
        assert_eq!(buckets.take("a", 1.0, start), Some(2));
        assert_eq!(buckets.take("b", 1.0, start), None, "another's bucket is its own");
        assert_eq!(buckets.take("a", 1.0, start + Duration::from_secs(2)), None);
        assert_eq!(buckets.take("a", 0.0, start + Duration::from_secs(2)), Some(2));
        assert_eq!(buckets.take("a", 0.0, start + Duration::from_secs(200)), None);
    }
}
