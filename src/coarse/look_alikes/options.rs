//! Options of the look-alike check.

use serde::{Deserialize, Serialize};

/// How look-alikes are told from true pairs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct LookAlikeOptions {
    /// Whether pairs are checked at all.
    pub enabled: bool,
    /// Cells along the longer side of an image for rating how much of it a pair matches: a match counts for a window of that
    /// size around it. More follow small surroundings better; with too many, a feature lost by chance looks like missing
    /// surroundings. Measured on random subsets of three sets of look-alikes: 8 to 12 do alike, more do worse.
    pub grid_cells: u32,
    /// A pair whose images stronger pairs connect already is taken without doubt when at least this share of its
    /// matches joins keypoints that the stronger pairs hold for one point too, of those whose keypoints both are in
    /// tracks of the stronger pairs. Raising it doubts more pairs; those that are true are kept all the same, for the
    /// price of a second coarse model.
    pub agreeing_share: f64,
    /// An undoubted pair may join two tracks into one when its strength is at least this share of the weakest link of the
    /// strongest chain between its images; weaker ones only extend tracks.
    pub joining_share: f64,
    /// The doubted pairs are judged only when one of them agrees in this share or less: then the set holds look-alikes, or a
    /// chain that comes back. Judging costs a coarse model.
    pub alarming_share: f64,
    /// A pair that a chain contradicts is a rival of a link of the chain when it has at least this share of its strength ...
    pub rival_share: f64,
    /// ... and at least so many times its matches. Origin of both: measured; where a link was wrong, true pairs had 0.7 of its
    /// strength and four times its matches, and wrong pairs of two sets of copies have at most 0.44 of that of a true link.
    pub rival_matches: f64,
    /// Rivals that are tried before their links, one after the other. Each costs a look at all matches.
    pub max_rivals: usize,
    /// Images of a cut pair are held apart for good, so that no point joins them, unless more than this share of its matches
    /// joins one place after all: pictures of one wall with a repeated pattern share the wall.
    pub shared_place_share: f64,
    /// So many matches must join that place, too. As many as verify a pair: a few may join one by chance.
    pub min_shared_place_matches: usize,
    /// Matches with a place for both keypoints that a judgement needs.
    pub min_judged_matches: usize,
    /// A doubted pair is cut when the two places of its median match lie farther apart than this, in units of their distance
    /// from the camera. It must exceed the drift of a chain that comes back and stay below the distance of copies.
    pub max_displacement: f64,
}

impl Default for LookAlikeOptions {
    fn default() -> Self {
        Self {
            enabled: true,
            grid_cells: 12,
            agreeing_share: 0.6,
            joining_share: 0.8,
            alarming_share: 0.25,
            rival_share: 0.6,
            rival_matches: 2.0,
            max_rivals: 8,
            shared_place_share: 0.1,
            min_shared_place_matches: 15,
            min_judged_matches: 8,
            max_displacement: 0.1,
        }
    }
}

impl LookAlikeOptions {
    /// Adds a sentence for every value out of range.
    pub fn validate(&self, errors: &mut Vec<String>) {
        let mut check = |holds: bool, message: &str| {
            if !holds {
                errors.push(format!("coarse.look_alikes.{message}"));
            }
        };
        check((2..=1000).contains(&self.grid_cells), "grid_cells must be from 2 to 1000");
        for (name, value) in [
            ("agreeing_share", self.agreeing_share),
            ("joining_share", self.joining_share),
            ("alarming_share", self.alarming_share),
            ("rival_share", self.rival_share),
            ("shared_place_share", self.shared_place_share),
        ] {
            check((0.0..=1.0).contains(&value), &format!("{name} must be in [0, 1]"));
        }
        check(self.rival_matches >= 1.0, "rival_matches must be at least 1");
        check(self.min_judged_matches >= 1, "min_judged_matches must be at least 1");
        check(self.max_displacement > 0.0, "max_displacement must be positive");
    }
}
