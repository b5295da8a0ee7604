//! Speed of exact descriptor matching, per set of instructions, on one thread: `cargo bench --bench matching`.

use std::hint::black_box;
use std::time::{Duration, Instant};

use multistage::matching::descriptor::{PackedDescriptors, Tier};
use multistage::math::Rng;
use multistage::scene::Descriptor;

/// The least time of several runs, in seconds: the least disturbed by whatever else the machine does.
fn least_s(mut work: impl FnMut()) -> f64 {
    let mut least = Duration::MAX;
    let started = Instant::now();
    for run in 0.. {
        let before = Instant::now();
        work();
        least = least.min(before.elapsed());
        if run >= 2 && started.elapsed() > Duration::from_millis(500) {
            break;
        }
    }
    least.as_secs_f64()
}

fn main() {
    let mut rng = Rng::from_parts(&[1]);
    // As RootSIFT has them: many small bytes, few large ones.
    let mut byte = || (130.0 * rng.uniform().powi(2)) as u8;
    let mut random = |n: usize| -> Vec<Descriptor> { (0..n).map(|_| std::array::from_fn(|_| byte())).collect() };
    println!("{:>11} {:>8} {:>8} {:>12} {:>18}", "", "queries", "rows", "Gpair/s", "Gpair/s both ways");
    for (num_queries, num_rows) in [(8192, 8192), (2000, 2000), (10, 80)] {
        let (queries, rows) = (random(num_queries), random(num_rows));
        let packed = PackedDescriptors::pack(&rows);
        let pairs = (num_queries * num_rows) as f64;
        let (mut of_queries, mut of_rows) = (Vec::new(), Vec::new());
        for &tier in Tier::ALL.iter().filter(|tier| tier.is_available()) {
            let one_way_s = least_s(|| tier.top2(black_box(&queries), &packed, &mut of_queries));
            let both_s = least_s(|| tier.top2_both(black_box(&queries), &packed, &mut of_queries, &mut of_rows));
            println!(
                "{:>11} {num_queries:>8} {num_rows:>8} {:>12.3} {:>18.3}",
                format!("{tier:?}"),
                1e-9 * pairs / one_way_s,
                1e-9 * pairs / both_s
            );
        }
        let mut packed = PackedDescriptors::new();
        let pack_s = least_s(|| packed.repack(black_box(&rows)));
        println!("{:>11} {:>8} {num_rows:>8} {:>12.1} ns a row", "packing", "", 1e9 * pack_s / num_rows as f64);
    }
}
