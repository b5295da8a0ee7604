//! The feature file of one image: keypoints, then descriptors, in the order the features are sorted in.
//!
//! Little-endian: magic `MSFEAT01`, count (u64), `count` keypoints of four f32 (x, y, scale, orientation), `count` descriptors
//! of 128 bytes. The fixed order lets a reader take the largest scales alone.

use crate::scene::{DESCRIPTOR_LEN, Features, Keypoint};

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
    }
}
