//! How much a token may keep.

use std::fmt;

use sqlx::SqliteConnection;

use super::StoreError;
use super::db::tokens;

/// What a token may keep at once; what is none has no limit of its own.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Quota {
    /// Bytes of photographs, those of open uploads included.
    pub bytes: Option<u64>,
    /// Jobs in any state; deleting one makes room.
    pub jobs: Option<u64>,
    /// Photographs.
    pub images: Option<u64>,
}

/// What a quota counts.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Quantity {
    /// Bytes of photographs.
    Bytes,
    /// Jobs.
    Jobs,
    /// Photographs.
    Images,
}

impl Quantity {
    /// Every quantity.
    pub const ALL: [Self; 3] = [Self::Bytes, Self::Jobs, Self::Images];

    /// The name in texts and arguments.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Bytes => "bytes",
            Self::Jobs => "jobs",
            Self::Images => "images",
        }
    }
}

impl Quota {
    /// The limit of a quantity.
    pub fn of(&self, quantity: Quantity) -> Option<u64> {
        match quantity {
            Quantity::Bytes => self.bytes,
            Quantity::Jobs => self.jobs,
            Quantity::Images => self.images,
        }
    }

    fn set(&mut self, quantity: Quantity, limit: u64) {
        match quantity {
            Quantity::Bytes => self.bytes = Some(limit),
            Quantity::Jobs => self.jobs = Some(limit),
            Quantity::Images => self.images = Some(limit),
        }
    }

    /// Reads `bytes=100G,jobs=10,images=5000`: any of the three, each with K, M, G or T for powers of 1024.
    ///
    /// # Errors
    /// The part that can't be read.
    pub fn parse(text: &str) -> Result<Self, String> {
        let mut quota = Self::default();
        for part in text.split(',').map(str::trim).filter(|part| !part.is_empty()) {
            let limit = part.split_once('=').and_then(|(name, number)| {
                let quantity = Quantity::ALL.into_iter().find(|quantity| quantity.as_str() == name.trim())?;
                Some((quantity, parse_number(number.trim())?))
            });
            let Some((quantity, limit)) = limit else {
                return Err(format!("{part:?} is not bytes=N, jobs=N or images=N"));
            };
            quota.set(quantity, limit);
        }
        Ok(quota)
    }
}

fn parse_number(text: &str) -> Option<u64> {
    let power = match text.chars().last()?.to_ascii_uppercase() {
        'K' => 1,
        'M' => 2,
        'G' => 3,
        'T' => 4,
        _ => 0,
    };
    let digits = if power > 0 { &text[..text.len() - 1] } else { text };
    // The database counts in signed numbers.
    let number = digits.parse::<u64>().ok()?.checked_mul(1 << (10 * power))?;
    i64::try_from(number).is_ok().then_some(number)
}

impl fmt::Display for Quota {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let limits = Quantity::ALL.iter().filter_map(|quantity| Some((quantity.as_str(), self.of(*quantity)?)));
        let limits: Vec<String> = limits.map(|(name, limit)| format!("{name}={limit}")).collect();
        f.write_str(if limits.is_empty() { "no quota" } else { "" })?;
        f.write_str(&limits.join(","))
    }
}

/// Fails when what a token keeps goes beyond its quota; to be asked within the transaction that added to it. Things of no token
/// have no quota.
pub(crate) async fn check(
    tx: &mut SqliteConnection,
    owner: Option<&str>,
    quantities: &[Quantity],
) -> Result<(), StoreError> {
    let Some(owner) = owner else { return Ok(()) };
    let Some(quota) = tokens::quota(&mut *tx, owner).await? else { return Ok(()) };
    if quantities.iter().all(|quantity| quota.of(*quantity).is_none()) {
        return Ok(());
    }
    let kept = tokens::usage(tx, owner).await?;
    for &quantity in quantities {
        let wanted = kept.of(quantity);
        if let Some(limit) = quota.of(quantity)
            && wanted > limit
        {
            return Err(StoreError::QuotaExceeded { quantity, limit, wanted });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn quotas_are_read_and_written() {
        let quota = Quota::parse("bytes=2G, images=5000").unwrap();
        assert_eq!(quota, Quota { bytes: Some(2 << 30), jobs: None, images: Some(5000) });
        assert_eq!(quota.to_string(), "bytes=2147483648,images=5000");
        assert_eq!(Quota::parse(&quota.to_string()).unwrap(), quota);
        assert_eq!((Quota::parse("").unwrap(), Quota::default().to_string().as_str()), (Quota::default(), "no quota"));
        for wrong in ["bytes", "bytes=", "bytes=-1", "disk=3", "jobs=1.5", "bytes=9999999T", "jobs=K"] {
            assert!(Quota::parse(wrong).is_err(), "{wrong}");
        }
    }
}
