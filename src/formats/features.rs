//! The feature file of one image: keypoints, then descriptors, in the order the features are sorted in.
//!
//! Little-endian: magic `MSFEAT01`, count (u64), `count` keypoints of four f32 (x, y, scale, orientation), `count` descriptors
//! of 128 bytes. The fixed order lets a reader take the largest scales alone.
//!
//! A set of such files is a folder with an [`FEATURE_SET_INDEX`], which says what photographs they stand for.

use serde::{Deserialize, Serialize};

use super::exif::Exif;
use crate::scene::{DESCRIPTOR_LEN, Features, Keypoint};

/// Name of the index of a set of feature files.
pub const FEATURE_SET_INDEX: &str = "index.json";

/// A set of feature files that stand for photographs.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FeatureSet {
    /// The images, in any order.
    pub images: Vec<FeatureSetImage>,
}

/// One image of a set.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct FeatureSetImage {
    /// Name of the photograph.
    pub name: String,
    /// Path of its feature file, relative to the index.
    pub file: String,
    /// Columns of the photograph.
    pub width: u32,
    /// Rows of the photograph.
    pub height: u32,
    /// What is known of how it was taken.
    #[serde(default)]
    pub exif: Exif,
}

const MAGIC: &[u8; 8] = b"MSFEAT01";
const HEADER_LEN: usize = 16;
const KEYPOINT_LEN: usize = size_of::<Keypoint>();

/// Why bytes are not a feature file.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum FeatureFileError {
    /// It does not begin as one.
    #[error("not a feature file")]
    WrongMagic,
    /// Its length does not fit its count.
    #[error("a feature file of {actual} bytes says it holds {count} features")]
    WrongLength {
        /// The count it states.
        count: u64,
        /// Its length in bytes.
        actual: usize,
    },
    /// Its features are not in order of descending scale, or are no numbers.
    #[error("feature {0} is out of order or no number: features are sorted by descending scale")]
    OutOfOrder(usize),
}

/// The file of these features.
pub fn to_bytes(features: &Features) -> Vec<u8> {
    let count = features.len();
    let mut bytes = Vec::with_capacity(HEADER_LEN + count * (KEYPOINT_LEN + DESCRIPTOR_LEN));
    bytes.extend_from_slice(MAGIC);
    bytes.extend_from_slice(&(count as u64).to_le_bytes());
    for keypoint in &features.keypoints {
        for value in [keypoint.x, keypoint.y, keypoint.scale, keypoint.orientation] {
            bytes.extend_from_slice(&value.to_le_bytes());
        }
    }
    for descriptor in &features.descriptors {
        bytes.extend_from_slice(descriptor);
    }
    bytes
}

/// The features of a file; with `limit`, only as many of the largest scales.
///
/// # Errors
/// When the bytes are not a whole feature file.
pub fn from_bytes(bytes: &[u8], limit: Option<usize>) -> Result<Features, FeatureFileError> {
    let header: &[u8; HEADER_LEN] = bytes.first_chunk().ok_or(FeatureFileError::WrongMagic)?;
    let (magic, count) = header.split_at(MAGIC.len());
    if magic != MAGIC {
        return Err(FeatureFileError::WrongMagic);
    }
    let count = u64::from_le_bytes(count.try_into().expect("eight bytes remain of the header"));
    let body = (bytes.len() - HEADER_LEN) as u64;
    if count.checked_mul((KEYPOINT_LEN + DESCRIPTOR_LEN) as u64) != Some(body) {
        return Err(FeatureFileError::WrongLength { count, actual: bytes.len() });
    }
    let count = count as usize;
    let taken = limit.map_or(count, |limit| limit.min(count));
    let value = |at: usize| f32::from_le_bytes(*bytes[at..].first_chunk().expect("the length was checked"));
    let keypoints = (0..taken).map(|k| {
        let at = HEADER_LEN + k * KEYPOINT_LEN;
        Keypoint { x: value(at), y: value(at + 4), scale: value(at + 8), orientation: value(at + 12) }
    });
    let descriptors_at = HEADER_LEN + count * KEYPOINT_LEN;
    let descriptors = bytes[descriptors_at..].as_chunks::<DESCRIPTOR_LEN>().0;
    Ok(Features { keypoints: keypoints.collect(), descriptors: descriptors[..taken].to_vec() })
}

/// Checks what readers of features rely on: numbers, by descending scale.
///
/// # Errors
/// [`FeatureFileError::OutOfOrder`] for the first feature that breaks it.
pub fn check_order(features: &Features) -> Result<(), FeatureFileError> {
    let mut scale = f32::MAX;
    for (at, keypoint) in features.keypoints.iter().enumerate() {
        let finite = [keypoint.x, keypoint.y, keypoint.orientation].iter().all(|value| value.is_finite());
        if !finite || !(0.0..=scale).contains(&keypoint.scale) {
            return Err(FeatureFileError::OutOfOrder(at));
        }
        scale = keypoint.scale;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn features_come_back() {
        let features = Features {
            keypoints: (0..5)
                .map(|k| Keypoint { x: k as f32, y: 2.5, scale: 9.0 - k as f32, orientation: 0.1 })
                .collect(),
            descriptors: (0..5).map(|k| [k as u8; 128]).collect(),
        };
        let bytes = to_bytes(&features);
        assert_eq!(from_bytes(&bytes, None), Ok(features.clone()));
        assert_eq!(from_bytes(&bytes, Some(2)).unwrap().keypoints, features.keypoints[..2]);
        assert!(from_bytes(&bytes[..bytes.len() - 1], None).is_err());
        assert_eq!(from_bytes(b"MSFEAT02________", None), Err(FeatureFileError::WrongMagic));
        assert_eq!(check_order(&features), Ok(()));
        let mut shuffled = features.clone();
        shuffled.keypoints.swap(1, 3);
        assert_eq!(check_order(&shuffled), Err(FeatureFileError::OutOfOrder(2)));
        shuffled = features;
        shuffled.keypoints[4].x = f32::NAN;
        assert_eq!(check_order(&shuffled), Err(FeatureFileError::OutOfOrder(4)));
    }
}
