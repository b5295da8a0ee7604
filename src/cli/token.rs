//! `multistage token`: who may use the service. Works while it runs.

use std::path::PathBuf;

use clap::Subcommand;

use super::Failure;
use super::data_dir::block_on;
use crate::jobs::view::time_text;
use crate::store::db::{now_ms, tokens};
use crate::store::{DataDir, Db, Quota, Scope, create_token};

/// Arguments of `multistage token`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The service's directory.
    #[arg(long, env = "MULTISTAGE_DATA_DIR", default_value = "./multistage-data", global = true)]
    data_dir: PathBuf,
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Make a token and print it, this once.
    Create {
        /// For whom or what.
        #[arg(long)]
        name: String,
        /// What it may do: read, submit, admin, with commas between.
        #[arg(long, default_value = "read,submit")]
        scopes: String,
        /// What it may keep, as bytes=100G,jobs=10,images=5000 or any of them [default: no limit].
        #[arg(long, default_value = "", value_parser = Quota::parse, hide_default_value = true)]
        quota: Quota,
    },
    /// Change what a token may keep.
    Quota {
        /// Its name or id.
        name: String,
        /// As bytes=100G,jobs=10,images=5000 or any of them; nothing for no limit.
        #[arg(value_parser = Quota::parse)]
        quota: Quota,
    },
    /// List the tokens; their secrets are kept nowhere.
    List,
    /// Make a token useless at once.
    Revoke {
        /// Its name or id.
        name: String,
    },
}

/// Runs the command.
pub(super) fn run(args: &Args) -> Result<(), Failure> {
    block_on(act(args))
}

async fn act(args: &Args) -> Result<(), Failure> {
    let outside = |error: &dyn std::fmt::Display| Failure::Outside(format!("{}: {error}", args.data_dir.display()));
    std::fs::create_dir_all(&args.data_dir).map_err(|error| outside(&error))?;
    let db = Db::open(&DataDir::database_in(&args.data_dir)).await.map_err(|error| outside(&error))?;
    match &args.action {
        Action::Create { name, scopes, quota } => {
            let scopes = Scope::parse_list(scopes)
                .ok_or_else(|| Failure::Input(format!("--scopes {scopes}: known are read, submit and admin")))?;
            let secret = create_token(&db, name, &scopes).await.map_err(|error| match error {
                sqlx::Error::Database(error) if error.is_unique_violation() => {
                    Failure::Input(format!("there is a token named {name:?} already"))
                }
                error => outside(&error),
            })?;
            set_quota(&db, name, quota).await.map_err(|error| outside(&error))?;
            println!("{secret}");
        }
        Action::Quota { name, quota } => {
            if !set_quota(&db, name, quota).await.map_err(|error| outside(&error))? {
                return Err(no_such_token(name));
            }
        }
        Action::List => {
            for token in tokens::list(db.reader()).await.map_err(|error| outside(&error))? {
                let state =
                    token.revoked_ms.map_or_else(|| "valid".to_owned(), |ms| format!("revoked {}", time_text(ms)));
                let (scopes, quota, created) = (&token.scopes, token.quota(), time_text(token.created_ms));
                println!("{}\t{}\t{scopes}\t{created}\t{state}\t{quota}", token.id, token.name);
            }
        }
        Action::Revoke { name } => {
            let mut tx = db.write().await.map_err(|error| outside(&error))?;
            let revoked = tokens::revoke(&mut tx, name, now_ms()).await.map_err(|error| outside(&error))?;
            tx.commit().await.map_err(|error| outside(&error))?;
            if !revoked {
                return Err(no_such_token(name));
            }
        }
    }
    db.close().await;
    Ok(())
}

async fn set_quota(db: &Db, name: &str, quota: &Quota) -> sqlx::Result<bool> {
    let mut tx = db.write().await?;
    let found = tokens::set_quota(&mut tx, name, quota).await?;
    tx.commit().await?;
    Ok(found)
}

fn no_such_token(name: &str) -> Failure {
    Failure::Input(format!("there is no valid token {name:?}"))
}
