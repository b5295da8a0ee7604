//! Whether a job fits into what the machine has left, and with how many threads.

use serde::Serialize;

use crate::pipeline::Needs;

/// Share of the memory that jobs may take together; the rest is for the service and the system's cache.
const USABLE_MEMORY: f64 = 0.85;

/// What the machine has.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Machine {
    /// Threads that a job may have.
    pub threads: usize,
    /// Memory that all jobs together may take.
    pub memory_bytes: u64,
}

impl Machine {
    /// `threads`, and the memory that the system or the process's control group allows; `memory_bytes` bounds it further.
    pub fn detect(threads: usize, memory_bytes: Option<u64>) -> Self {
        let limits = [system_memory_bytes(), group_memory_bytes()];
        let there = limits.into_iter().flatten().min().map(|bytes| (USABLE_MEMORY * bytes as f64) as u64);
        let memory_bytes = [there, memory_bytes].into_iter().flatten().min().unwrap_or(u64::MAX);
        Self { threads, memory_bytes }
    }
}

/// All memory of the machine.
fn system_memory_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemTotal:"))?;
    line.trim().strip_suffix("kB")?.trim().parse::<u64>().ok().map(|kibibytes| 1024 * kibibytes)
}

/// What the control group of the process may take, as in a container or a unit of systemd.
fn group_memory_bytes() -> Option<u64> {
    let groups = std::fs::read_to_string("/proc/self/cgroup").ok()?;
    let group = groups.lines().find_map(|line| line.strip_prefix("0::"))?.trim().trim_start_matches('/');
    let limit = std::fs::read_to_string(std::path::Path::new("/sys/fs/cgroup").join(group).join("memory.max"));
    limit.ok()?.trim().parse().ok()
}

/// Whether a job can start.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Fit {
    /// With so many threads; a sentence where they are fewer than all.
    Start {
        /// Worker threads.
        threads: usize,
        /// Why not more.
        note: Option<String>,
    },
    /// Once others end or space returns.
    Wait(Hold),
    /// Never on this machine.
    Never(String),
}

/// What a waiting job waits for besides its turn.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Hold {
    /// Room on the disk.
    DiskFull,
    /// Memory that other jobs have.
    Memory,
}

impl Hold {
    /// Every one.
    pub const ALL: [Self; 2] = [Self::DiskFull, Self::Memory];

    /// The name on the wire and in the database.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::DiskFull => "disk_full",
            Self::Memory => "memory",
        }
    }
}

/// Whether a job fits: `taken_bytes` is the memory of the running jobs, `disk_bytes` the room on the disk,
/// `written_bytes` what an earlier attempt of the job wrote already.
pub fn fit(needs: &Needs, machine: &Machine, taken_bytes: u64, disk_bytes: u64, written_bytes: u64) -> Fit {
    let megabytes = |bytes: u64| bytes.div_ceil(1_000_000);
    let least = needs.memory_bytes(1);
    if least > machine.memory_bytes {
        return Fit::Never(format!(
            "the {} photographs need about {} MB of memory with one thread, and jobs may take {} MB here",
            needs.images,
            megabytes(least),
            megabytes(machine.memory_bytes)
        ));
    }
    if needs.disk_bytes.saturating_sub(written_bytes) > disk_bytes {
        return Fit::Wait(Hold::DiskFull);
    }
    let left = machine.memory_bytes.saturating_sub(taken_bytes);
    let Some(threads) = needs.threads_within(left, machine.threads.max(1)) else { return Fit::Wait(Hold::Memory) };
    let note = (threads < machine.threads).then(|| {
        format!(
            "{threads} of {} threads: with more, the run might need {} MB of memory, and {} MB are left",
            machine.threads,
            megabytes(needs.memory_bytes(threads + 1)),
            megabytes(left)
        )
    });
    Fit::Start { threads, note }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NEEDS: Needs =
        Needs { images: 9, disk_bytes: 1000, shared_memory_bytes: 100_000_000, thread_memory_bytes: 50_000_000 };

    #[test]
    fn a_job_starts_with_fewer_threads_waits_or_never_starts() {
        let machine = Machine { threads: 4, memory_bytes: 300_000_000 };
        let fit = |machine: &Machine, taken, disk, written| super::fit(&NEEDS, machine, taken, disk, written);
        assert_eq!(fit(&machine, 0, 1000, 0), Fit::Start { threads: 4, note: None });
        let Fit::Start { threads: 2, note: Some(note) } = fit(&machine, 80_000_000, 1000, 0) else { panic!() };
        assert!(note.contains("2 of 4 threads") && note.contains("250 MB") && note.contains("220 MB"), "{note}");
        assert_eq!(fit(&machine, 200_000_000, 1000, 0), Fit::Wait(Hold::Memory));
        assert_eq!(fit(&machine, 0, 999, 0), Fit::Wait(Hold::DiskFull));
        assert_eq!(fit(&machine, 0, 999, 1), Fit::Start { threads: 4, note: None }, "goes on from what it wrote");
        let small = Machine { threads: 4, memory_bytes: 149_000_000 };
        let Fit::Never(why) = fit(&small, 0, 1000, 0) else { panic!() };
        assert!(why.contains("9 photographs") && why.contains("150 MB") && why.contains("149 MB"), "{why}");
    }

    #[test]
    fn the_machine_is_known_and_can_be_bounded() {
        assert!(Machine::detect(2, None).memory_bytes > 64 << 20);
        assert_eq!(Machine::detect(2, Some(5)), Machine { threads: 2, memory_bytes: 5 });
    }
}
