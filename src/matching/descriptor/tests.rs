use super::*;
use crate::math::{Grouped, Rng};
use crate::scene::DESCRIPTOR_LEN;

/// Half of the bytes full-range at random, sometimes all 0 or all 255, and now and then a repeat, so that ties occur.
fn descriptors(rng: &mut Rng, n: usize) -> Vec<Descriptor> {
    let mut all: Vec<Descriptor> = Vec::with_capacity(n);
    for _ in 0..n {
        let next = match rng.below(8) {
            0 => [0; DESCRIPTOR_LEN],
            1 => [255; DESCRIPTOR_LEN],
            2 if !all.is_empty() => all[rng.below(all.len())],
            3 => std::array::from_fn(|_| if rng.below(2) == 0 { 0 } else { 255 }),
            _ => std::array::from_fn(|_| rng.below(256) as u8),
        };
        all.push(next);
    }
    all
}

/// The definition, without any layout.
fn brute_force(queries: &[Descriptor], rows: &[Descriptor]) -> Vec<Top2> {
    let nearest = |query: &Descriptor| {
        let mut ranked: Vec<(u32, u32)> = (0u32..).zip(rows).map(|(i, row)| (distance_sq(query, row), i)).collect();
        ranked.sort_unstable();
        let &(distance_sq, index) = ranked.first()?;
        Some(Top2 { index, distance_sq, second_distance_sq: ranked.get(1).map(|second| second.0) })
    };
    queries.iter().filter_map(nearest).collect()
}

#[test]
fn every_tier_agrees_with_the_definition() {
    let mut rng = Rng::from_parts(&[1]);
    for (num_queries, num_rows) in
        [(1, 1), (1, 2), (7, 15), (6, 16), (13, 17), (10, 80), (23, 33), (40, 2100), (0, 5), (5, 0)]
    {
        let queries = descriptors(&mut rng, num_queries);
        let rows = descriptors(&mut rng, num_rows);
        let packed = PackedDescriptors::pack(&rows);
        let expected = brute_force(&queries, &rows);
        let expected_of_rows = brute_force(&rows, &queries);
        for &tier in Tier::ALL.iter().filter(|tier| tier.is_available()) {
            let (mut out, mut of_rows) = (Vec::new(), Vec::new());
            tier.top2(&queries, &packed, &mut out);
            assert_eq!(out, expected, "{tier:?} {num_queries} {num_rows}");
            tier.top2_both(&queries, &packed, &mut out, &mut of_rows);
            assert_eq!(out, expected, "{tier:?} {num_queries} {num_rows}");
            assert_eq!(of_rows, expected_of_rows, "{tier:?} {num_queries} {num_rows}");
        }
    }
}

/// Bytes at the ends of their range as often as not, on both sides of what sums of 16 bits hold: with 64 taken off, 191 is the
/// largest byte of a query that eight bits hold, and 127 * 4 * 64 the largest sum of four products that sixteen do.
#[test]
fn every_tier_agrees_where_short_sums_end() {
    let mut rng = Rng::from_parts(&[8]);
    for largest_of_queries in [60, 128, 129, 191, 192, 255] {
        for largest_of_rows in [40, 64, 65, 127, 128, 255] {
            let mut bytes_up_to = |largest: usize, n: usize| -> Vec<Descriptor> {
                let mut byte = || [0, largest, rng.below(largest + 1), largest][rng.below(4)] as u8;
                (0..n).map(|_| std::array::from_fn(|_| byte())).collect()
            };
            let mut queries = bytes_up_to(largest_of_queries, 9);
            let mut rows = bytes_up_to(largest_of_rows, 40);
            queries.push([largest_of_queries as u8; DESCRIPTOR_LEN]);
            rows.push([largest_of_rows as u8; DESCRIPTOR_LEN]);
            let packed = PackedDescriptors::pack(&rows);
            let (expected, expected_of_rows) = (brute_force(&queries, &rows), brute_force(&rows, &queries));
            for &tier in Tier::ALL.iter().filter(|tier| tier.is_available()) {
                let (mut out, mut of_rows) = (Vec::new(), Vec::new());
                tier.top2_both(&queries, &packed, &mut out, &mut of_rows);
                assert_eq!(out, expected, "{tier:?} {largest_of_queries} {largest_of_rows}");
                assert_eq!(of_rows, expected_of_rows, "{tier:?} {largest_of_queries} {largest_of_rows}");
            }
        }
    }
}

#[test]
fn the_least_distance_is_the_definition_s_in_every_tier() {
    let mut rng = Rng::from_parts(&[7]);
    let rows = descriptors(&mut rng, 90);
    for length in [0, 1, 2, 40] {
        let indices: Vec<u32> = (0..length).map(|_| rng.below(rows.len()) as u32).collect();
        for query in descriptors(&mut rng, 20) {
            let expected = indices.iter().map(|&index| distance_sq(&query, &rows[index as usize])).min();
            for &tier in Tier::ALL.iter().filter(|tier| tier.is_available()) {
                assert_eq!(tier.least_distance_sq(&query, &rows, &indices), expected, "{tier:?}");
            }
        }
    }
}

#[test]
fn the_largest_distance_does_not_overflow() {
    let (black, white) = ([0; DESCRIPTOR_LEN], [255; DESCRIPTOR_LEN]);
    for (query, row) in [(black, white), (white, black)] {
        for &tier in Tier::ALL.iter().filter(|tier| tier.is_available()) {
            let mut out = Vec::new();
            tier.top2(&[query], &PackedDescriptors::pack(&[row]), &mut out);
            assert_eq!(out, [Top2 { index: 0, distance_sq: 128 * 255 * 255, second_distance_sq: None }]);
        }
    }
}

#[test]
fn a_subset_is_numbered_by_its_list_and_memory_is_reused() {
    let mut rng = Rng::from_parts(&[2]);
    let rows = descriptors(&mut rng, 300);
    let queries = descriptors(&mut rng, 9);
    let mut packed = PackedDescriptors::pack(&rows);
    for subset in [vec![299, 0, 17, 17, 5], (0..100).rev().collect(), vec![3]] {
        packed.repack_subset(&rows, &subset);
        assert_eq!(packed.len(), subset.len());
        let chosen: Vec<Descriptor> = subset.iter().map(|&i| rows[i as usize]).collect();
        let mut out = vec![Top2 { index: 9, distance_sq: 9, second_distance_sq: None }];
        top2(&queries, &packed, &mut out);
        assert_eq!(out, brute_force(&queries, &chosen));
        top2(&queries, &PackedDescriptors::pack_subset(&rows, &subset), &mut out);
        assert_eq!(out, brute_force(&queries, &chosen));
    }
}

#[cfg(target_arch = "x86_64")]
#[test]
fn packing_is_the_same_with_and_without_vectors() {
    use super::packed::{GROUP_ROWS, Line, QUADS, pack_group_plainly};
    if !std::is_x86_feature_detected!("avx2") {
        println!("SKIPPED: this machine has no AVX2");
        return;
    }
    let descriptors = descriptors(&mut Rng::from_parts(&[3]), GROUP_ROWS);
    let rows = std::array::from_fn(|row| &descriptors[row]);
    let empty = || ([Line([[0; 4]; GROUP_ROWS]); QUADS], [0; GROUP_ROWS]);
    let ((mut plain, mut plain_biases), (mut lines, mut biases)) = (empty(), empty());
    let plain_short = pack_group_plainly(&rows, &mut plain, &mut plain_biases);
    // SAFETY: AVX2 is there.
    let short = unsafe { super::x86::pack_group(&rows, &mut lines, &mut biases) };
    assert_eq!((short, biases), (plain_short, plain_biases));
    assert!(lines.iter().zip(&plain).all(|(a, b)| a.0 == b.0));
}

/// Rows in a few sections, queries with random lines, and windows that hold more than their bands: every tier finds what the
/// definition says.
#[test]
fn every_tier_agrees_on_bands() {
    let mut rng = Rng::from_parts(&[4]);
    for (num_queries, sections) in
        [(1, vec![3]), (9, vec![40, 5, 33]), (30, vec![100, 0, 17]), (0, vec![5]), (3, vec![])]
    {
        let num_rows = sections.iter().sum();
        let (queries, descriptors) = (descriptors(&mut rng, num_queries), descriptors(&mut rng, num_rows));
        let positions: Vec<[f32; 2]> = (0..num_rows).map(|_| [(); 2].map(|()| rng.range(-50.0, 50.0) as f32)).collect();
        let (mut rows, mut slots, mut next) = (BandedRows::default(), Vec::new(), 0u32);
        for section in sections {
            let indices: Vec<u32> = (next..next + section as u32).collect();
            slots.extend((0u32..).take(section).map(|k| rows.slots() as u32 + k));
            rows.append(&descriptors, &indices, |index| positions[index as usize]);
            next += section as u32;
        }
        let bands: Vec<BandQuery> = queries
            .iter()
            .map(|descriptor| {
                let angle = rng.range(0.0, 3.0);
                let line = [angle.cos() as f32, angle.sin() as f32, rng.range(-20.0, 20.0) as f32];
                BandQuery { descriptor, line, half_width: rng.range(0.0, 30.0) as f32 }
            })
            .collect();
        let groups = BandedRows::groups_of(0..rows.slots());
        // The whole, cut in two somewhere, so that the windows of a block overlap.
        let windows: Vec<std::ops::Range<u32>> = bands
            .iter()
            .flat_map(|_| {
                let cut = rng.below(groups.end as usize + 1) as u32;
                [0..cut, cut..groups.end]
            })
            .collect();
        let ranks: Vec<u32> = bands.iter().map(|_| rng.below(rows.slots() + 2) as u32).collect();
        let expected: Vec<BandTop2> = bands
            .iter()
            .map(|band| {
                let near = (0..num_rows).filter(|&r| band.contains(positions[r][0], positions[r][1]));
                let mut ranked: Vec<(u32, u32)> =
                    near.map(|r| (distance_sq(band.descriptor, &descriptors[r]), slots[r])).collect();
                ranked.sort_unstable();
                BandTop2 {
                    nearest: ranked.first().map(|&(distance, slot)| (slot, distance)),
                    second_distance_sq: ranked.get(1).map(|second| second.0),
                    candidates: ranked.len() as u32,
                }
            })
            .collect();
        let expected_of_rows: Vec<Option<usize>> = (0..num_rows)
            .map(|r| {
                let near = (0..bands.len()).filter(|&q| bands[q].contains(positions[r][0], positions[r][1]));
                near.min_by_key(|&q| distance_sq(bands[q].descriptor, &descriptors[r]))
            })
            .collect();
        let expected_off: Vec<Option<u32>> = bands
            .iter()
            .zip(&ranks)
            .map(|(band, &rank)| {
                let off =
                    (0..num_rows).filter(|&r| !band.contains(positions[r][0], positions[r][1]) && slots[r] < rank);
                off.map(|r| distance_sq(band.descriptor, &descriptors[r])).min()
            })
            .collect();
        for &tier in Tier::ALL.iter().filter(|tier| tier.is_available()) {
            let (mut found, mut of_rows, mut off) = (Vec::new(), NearestQueries::default(), Vec::new());
            tier.top2_in_bands(&bands, &windows, &rows, &mut found, &mut of_rows);
            assert_eq!(found, expected, "{tier:?} {num_queries} {num_rows}");
            let of_rows: Vec<Option<usize>> = slots.iter().map(|&slot| of_rows.of(slot)).collect();
            assert_eq!(of_rows, expected_of_rows, "{tier:?} {num_queries} {num_rows}");
            tier.nearest_off_bands(&bands, &ranks, &rows, &mut off);
            assert_eq!(off, expected_off, "{tier:?} {num_queries} {num_rows}");
        }
    }
}

/// Ranks 0 to `n` in some of the cells each, ascending.
fn cells_of(rng: &mut Rng, n: usize, num_cells: usize) -> Vec<(u32, u32)> {
    let mut entries = Vec::new();
    for rank in 0..n as u32 {
        entries.extend((0..num_cells as u32).filter(|_| rng.below(3) == 0).map(|cell| (cell, rank)));
    }
    entries
}

#[test]
fn every_tier_agrees_within_cells() {
    let mut rng = Rng::from_parts(&[12]);
    for (num_queries, num_rows, num_cells) in [(1, 1, 1), (9, 40, 3), (30, 5, 7), (70, 300, 4), (0, 20, 2), (20, 0, 2)]
    {
        let (queries, rows) = (descriptors(&mut rng, num_queries), descriptors(&mut rng, num_rows));
        let visits = cells_of(&mut rng, num_queries, num_cells);
        let own: Vec<(u32, u32)> = (0..num_rows as u32).map(|row| (rng.below(num_cells) as u32, row)).collect();
        let visitors = Grouped::new(num_cells, visits.iter().copied());
        let celled = CellRows::pack(&rows, &Grouped::new(num_cells, own.iter().copied()));
        // By definition: best and second of what shares a cell.
        let nearest = |query: &Descriptor, cells: &[u32]| {
            let seen = own.iter().filter(|(cell, _)| cells.contains(cell)).map(|&(_, row)| row);
            let mut distances: Vec<u32> = seen.map(|row| distance_sq(query, &rows[row as usize])).collect();
            distances.sort_unstable();
            Some((*distances.first()?, distances.get(1).copied()))
        };
        let visited = |query: usize| -> Vec<u32> {
            visits.iter().filter(|&&(_, rank)| rank as usize == query).map(|&(cell, _)| cell).collect()
        };
        let told = |found: &Top2| (found.distance_sq, found.second_distance_sq);
        for &tier in Tier::ALL.iter().filter(|tier| tier.is_available()) {
            let (mut of_queries, mut of_slots) = (Vec::new(), Vec::new());
            tier.top2_in_cells(&queries, &visitors, &celled, &mut of_queries, &mut of_slots);
            assert_eq!(of_queries.len(), num_queries);
            for (at, (query, found)) in queries.iter().zip(&of_queries).enumerate() {
                assert_eq!(found.as_ref().map(told), nearest(query, &visited(at)), "{tier:?} {at}");
                assert_eq!(&tier.top2_of_cells(query, &visited(at), &celled), found, "{tier:?} {at}");
                if let Some(found) = found {
                    let row = celled.rank(found.index) as usize;
                    assert_eq!(distance_sq(query, &rows[row]), found.distance_sq, "{tier:?} {at}");
                }
            }
            let slots = own.iter().map(|&(cell, row)| {
                let of_row = |slot: &usize| celled.rank(*slot as u32) == row;
                ((0..of_slots.len()).find(of_row).unwrap(), cell, row)
            });
            for (slot, cell, row) in slots {
                let mut asked: Vec<(u32, u32)> = visitors
                    .group(cell as usize)
                    .iter()
                    .map(|&query| (distance_sq(&queries[query as usize], &rows[row as usize]), query))
                    .collect();
                asked.sort_unstable();
                let expected = asked.first().map(|&(distance_sq, index)| Top2 {
                    index,
                    distance_sq,
                    second_distance_sq: asked.get(1).map(|second| second.0),
                });
                assert_eq!(of_slots[slot], expected, "{tier:?} row {row}");
            }
        }
    }
}

#[test]
fn every_tier_agrees_on_all_distances() {
    let mut rng = Rng::from_parts(&[13]);
    for (num_queries, num_rows) in [(1, 1), (7, 16), (13, 50), (0, 3), (3, 0)] {
        let (queries, rows) = (descriptors(&mut rng, num_queries), descriptors(&mut rng, num_rows));
        let expected: Vec<u32> =
            queries.iter().flat_map(|query| rows.iter().map(|row| distance_sq(query, row))).collect();
        for &tier in Tier::ALL.iter().filter(|tier| tier.is_available()) {
            let mut out = vec![7];
            tier.distances_sq(&queries, &PackedDescriptors::pack(&rows), &mut out);
            assert_eq!(out, expected, "{tier:?} {num_queries} {num_rows}");
        }
    }
}
