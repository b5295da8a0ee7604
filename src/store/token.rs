//! Secrets that open the service: 256 random bits, of which only a hash is kept.

use base64::Engine;
use base64::prelude::BASE64_URL_SAFE_NO_PAD;
use uuid::Uuid;

use super::db::tokens::{self, TokenRow};
use super::db::{Db, now_ms};

/// What every secret starts with, so that people and scanners of leaked secrets know it.
const PREFIX: &str = "msf_";
/// Random bytes of a secret.
const SECRET_BYTES: usize = 32;

/// What a token may do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Scope {
    /// Look at what is its own.
    Read,
    /// Upload, queue, cancel and delete what is its own.
    Submit,
    /// Everything, also of others.
    Admin,
}

impl Scope {
    /// Every scope.
    pub const ALL: [Self; 3] = [Self::Read, Self::Submit, Self::Admin];

    /// The name.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Read => "read",
            Self::Submit => "submit",
            Self::Admin => "admin",
        }
    }

    /// The scopes of a list with commas; none when one of them is unknown or there is none.
    pub fn parse_list(list: &str) -> Option<Vec<Self>> {
        let named = |name: &str| Self::ALL.into_iter().find(|scope| scope.as_str() == name.trim());
        let mut scopes: Vec<Self> = list.split(',').map(named).collect::<Option<_>>()?;
        scopes.sort_unstable();
        scopes.dedup();
        Some(scopes)
    }
}

fn hash(secret: &str) -> blake3::Hash {
    blake3::hash(secret.as_bytes())
}

/// Makes a token; the secret is given once and kept nowhere.
///
/// # Errors
/// What SQLite said, for instance because the name is taken.
pub async fn create_token(db: &Db, name: &str, scopes: &[Scope]) -> Result<String, sqlx::Error> {
    let mut random = [0; SECRET_BYTES];
    getrandom::fill(&mut random).map_err(|error| sqlx::Error::Io(std::io::Error::other(error.to_string())))?;
    let secret = format!("{PREFIX}{}", BASE64_URL_SAFE_NO_PAD.encode(random));
    let scopes: Vec<&str> = scopes.iter().map(|scope| scope.as_str()).collect();
    let row = TokenRow {
        id: Uuid::now_v7().to_string(),
        name: name.to_owned(),
        hash: hash(&secret).to_hex().to_string(),
        scopes: scopes.join(","),
        created_ms: now_ms(),
        revoked_ms: None,
        quota_bytes: None,
        quota_jobs: None,
        quota_images: None,
    };
    let mut tx = db.write().await?;
    tokens::insert(&mut tx, &row).await?;
    tx.commit().await?;
    Ok(secret)
}

/// The token that a secret belongs to and that still holds. Every token is compared, each in constant time, so that the time
/// tells nothing about how near a guess was.
///
/// # Errors
/// What SQLite said.
pub async fn find_token(db: &Db, secret: &str) -> Result<Option<TokenRow>, sqlx::Error> {
    let offered = hash(secret);
    let mut found = None;
    for row in tokens::list(db.reader()).await? {
        // Comparing two of blake3's hashes takes constant time.
        let fits = blake3::Hash::from_hex(&row.hash).is_ok_and(|known| known == offered);
        if fits && row.revoked_ms.is_none() {
            found = Some(row);
        }
    }
    Ok(found)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[tokio::test]
    async fn a_secret_opens_until_it_is_revoked_and_is_kept_nowhere() {
        let folder = tempfile::tempdir().unwrap();
        let db = Db::open(&folder.path().join("x.db")).await.unwrap();
        let secret = create_token(&db, "a", &[Scope::Read, Scope::Submit]).await.unwrap();
        assert!(secret.len() > 40 && secret != create_token(&db, "b", &[Scope::Admin]).await.unwrap());
        assert!(create_token(&db, "a", &[Scope::Read]).await.is_err(), "the name is taken");
        let row = find_token(&db, &secret).await.unwrap().unwrap();
        assert_eq!((row.name.as_str(), row.scopes.as_str()), ("a", "read,submit"));
        assert!(!format!("{row:?}").contains(&secret[4..]));
        assert_eq!(find_token(&db, &secret[..40]).await.unwrap(), None);
        let mut tx = db.write().await.unwrap();
        assert!(tokens::revoke(&mut tx, "a", 1).await.unwrap());
        assert!(!tokens::revoke(&mut tx, "a", 1).await.unwrap());
        tx.commit().await.unwrap();
        assert_eq!(find_token(&db, &secret).await.unwrap(), None);
    }

    #[test]
    fn scopes_are_read_from_lists() {
        assert_eq!(Scope::parse_list("submit, read,read"), Some(vec![Scope::Read, Scope::Submit]));
        assert_eq!((Scope::parse_list(""), Scope::parse_list("read,root")), (None, None));
    }
}
