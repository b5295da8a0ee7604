//! Clusters of descriptors.
//!
//! Lloyd's iterations from random members (always the same ones), with exact nearest centres from the matching kernels and
//! centres rounded to bytes, so that they are exact integer work and the same everywhere.

use rayon::prelude::*;

use super::descriptor::{PackedDescriptors, Top2, top2};
use crate::math::Rng;
use crate::scene::{DESCRIPTOR_LEN, Descriptor};

/// Descriptors one thread looks up at a time: enough to pay for handing them out.
const CHUNK: usize = 1024;
/// The random stream that picks the first centres.
const STREAM: u64 = 0x776f_7264;

/// The nearest centre of every descriptor; empty when there are no centres.
pub fn nearest(descriptors: &[Descriptor], centers: &PackedDescriptors) -> Vec<u32> {
    let chunks = descriptors.par_chunks(CHUNK).map(|chunk| {
        let mut found: Vec<Top2> = Vec::new();
        top2(chunk, centers, &mut found);
        found.into_iter().map(|found| found.index).collect::<Vec<u32>>()
    });
    chunks.flatten_iter().collect()
}

/// At most `count` centres of clusters of `members`. A centre that loses all members stays where it is.
pub fn k_means(members: &[Descriptor], count: usize, iterations: usize) -> Vec<Descriptor> {
    let count = count.min(members.len());
    let mut order: Vec<u32> = (0..members.len() as u32).collect();
    Rng::from_parts(&[STREAM]).shuffle(&mut order);
    let mut centers: Vec<Descriptor> = order[..count].iter().map(|&member| members[member as usize]).collect();
    let mut packed = PackedDescriptors::new();
    let mut assigned: Vec<u32> = Vec::new();
    for _ in 0..iterations {
        packed.repack(&centers);
        let now = nearest(members, &packed);
        if now == assigned {
            break;
        }
        assigned = now;
        let mut sums = vec![[0u64; DESCRIPTOR_LEN]; count];
        let mut sizes = vec![0u64; count];
        for (member, &word) in members.iter().zip(&assigned) {
            sizes[word as usize] += 1;
            for (sum, &byte) in sums[word as usize].iter_mut().zip(member) {
                *sum += u64::from(byte);
            }
        }
        for ((center, sum), &size) in centers.iter_mut().zip(&sums).zip(&sizes) {
            if size > 0 {
                *center = sum.map(|sum| ((sum + size / 2) / size) as u8);
            }
        }
    }
    centers
}
