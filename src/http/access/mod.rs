//! Who asks, what they may do, and whose things they see.
//!
//! Where tokens are required, every address of the interface wants one: as `Authorization: Bearer`, or as the password of HTTP
//! Basic (any user name), which browsers ask for by themselves. A thing of another token is as if it were not there.

mod browsers;
mod rate;

pub(super) use browsers::guard_browsers;
pub use rate::RateLimits;

use std::net::{IpAddr, SocketAddr};

use axum::extract::rejection::RawPathParamsRejection;
use axum::extract::{ConnectInfo, FromRequestParts, RawPathParams, Request, State};
use axum::http::request::Parts;
use axum::http::{HeaderMap, HeaderValue, Method, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use uuid::Uuid;

use super::AppState;
use super::problem::{Code, Problem};
use crate::store::db::tokens::{self, Owned};
use crate::store::{Scope, find_token};

/// Who asks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Principal {
    /// Anybody, where no token is required.
    Anybody,
    /// Who has this token.
    Token { id: Uuid, scopes: Vec<Scope> },
}

impl Principal {
    fn may(&self, scope: Scope) -> bool {
        match self {
            Self::Anybody => true,
            Self::Token { scopes, .. } => scopes.contains(&scope) || scopes.contains(&Scope::Admin),
        }
    }

    /// Whose things it sees; none for everything.
    pub(super) fn sees_only(&self) -> Option<String> {
        match self {
            Self::Token { id, .. } if !self.may(Scope::Admin) => Some(id.to_string()),
            _ => None,
        }
    }

    /// Whose what it makes is.
    pub(super) fn owner(&self) -> Option<Uuid> {
        match self {
            Self::Anybody => None,
            Self::Token { id, .. } => Some(*id),
        }
    }

    /// Fails unless the principal may give a job this priority: to push ahead of others is for those who answer for all.
    pub(super) fn check_priority(&self, priority: i64) -> Result<(), Problem> {
        if priority > 0 && !self.may(Scope::Admin) {
            return Err(Problem::new(Code::Forbidden).detail("a priority above 0 needs the scope `admin`"));
        }
        Ok(())
    }

    /// Fails with the problem of a missing thing unless the principal may see it.
    pub(super) async fn check_sees(&self, state: &AppState, thing: Owned) -> Result<(), Problem> {
        let Some(own) = self.sees_only() else { return Ok(()) };
        match tokens::owner(state.jobs.store.db.reader(), thing).await? {
            Some(Some(owner)) if owner == own => Ok(()),
            _ => Err(Problem::new(match thing {
                Owned::Dataset(_) => Code::DatasetNotFound,
                Owned::Job(_) => Code::JobNotFound,
                Owned::Upload(_) => Code::UploadNotFound,
            })),
        }
    }
}

impl<S: Send + Sync> FromRequestParts<S> for Principal {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        // The middleware below puts it there, for every route that has it.
        parts.extensions.get::<Self>().cloned().ok_or_else(|| Problem::new(Code::Unauthorized))
    }
}

/// Lets a request through to its route once it is known who asks, that they may, and that what the address names is theirs.
pub(super) async fn admit(
    State(state): State<AppState>,
    params: Result<RawPathParams, RawPathParamsRejection>,
    mut request: Request,
    next: Next,
) -> Response {
    let (sender, secret) = (Sender::of(&request), secret(request.headers()));
    let principal = match identify(&state, sender, secret).await {
        Ok(principal) => principal,
        Err(refusal) => return refusal,
    };
    // An address that is not UTF-8 leads nowhere.
    let Ok(params) = params else { return Problem::new(Code::NotFound).into_response() };
    for (name, value) in &params {
        let thing = match (name, value.parse()) {
            ("dataset_id", Ok(id)) => Owned::Dataset(id),
            ("job_id", Ok(id)) => Owned::Job(id),
            ("upload_id", Ok(id)) => Owned::Upload(id),
            _ => continue,
        };
        if let Err(problem) = principal.check_sees(&state, thing).await {
            return problem.into_response();
        }
    }
    request.extensions_mut().insert(principal);
    next.run(request).await
}

/// What a request says about its sender besides a secret.
pub(super) struct Sender {
    address: Option<IpAddr>,
    /// What its method needs.
    scope: Scope,
}

impl Sender {
    pub(super) fn of(request: &Request) -> Self {
        let scope = match *request.method() {
            Method::GET | Method::HEAD | Method::OPTIONS => Scope::Read,
            _ => Scope::Submit,
        };
        Self { address: request.extensions().get::<ConnectInfo<SocketAddr>>().map(|info| info.0.ip()), scope }
    }
}

/// Who sends a request with this secret, once it is known that they may do what its method does.
pub(super) async fn identify(state: &AppState, sender: Sender, secret: Option<String>) -> Result<Principal, Response> {
    let principal = authenticate(state, secret, sender.address).await?;
    if !principal.may(sender.scope) {
        let message = format!("the token lacks the scope `{}`", sender.scope.as_str());
        return Err(Problem::new(Code::Forbidden).detail(message).into_response());
    }
    Ok(principal)
}

async fn authenticate(
    state: &AppState,
    secret: Option<String>,
    address: Option<IpAddr>,
) -> Result<Principal, Response> {
    if !state.config.access.token_required {
        return Ok(Principal::Anybody);
    }
    if let Some(wait_s) = address.and_then(|address| state.rates.blocked_for_s(address)) {
        return Err(too_many(wait_s));
    }
    let Some(secret) = secret else { return Err(unauthorized()) };
    let found = find_token(&state.jobs.store.db, &secret).await.map_err(|e| Problem::from(e).into_response())?;
    let Some(token) = found else {
        if let Some(address) = address {
            state.rates.failed(address);
        }
        return Err(unauthorized());
    };
    if let Some(wait_s) = state.rates.spend(&token.id) {
        return Err(too_many(wait_s));
    }
    let id = token.id.parse().map_err(|error| Problem::internal(&error).into_response())?;
    Ok(Principal::Token { id, scopes: Scope::parse_list(&token.scopes).unwrap_or_default() })
}

/// The secret a request brings; one that can't be read is none that fits.
pub(super) fn secret(headers: &HeaderMap) -> Option<String> {
    let header = headers.get(header::AUTHORIZATION)?;
    Some(read_secret(header).unwrap_or_default())
}

fn read_secret(header: &HeaderValue) -> Option<String> {
    let (scheme, value) = header.to_str().ok()?.split_once(' ')?;
    if scheme.eq_ignore_ascii_case("bearer") {
        return Some(value.trim().to_owned());
    }
    if scheme.eq_ignore_ascii_case("basic") {
        let pair = String::from_utf8(BASE64_STANDARD.decode(value.trim()).ok()?).ok()?;
        return pair.split_once(':').map(|(_, password)| password.to_owned());
    }
    None
}

/// The same for no token, a wrong one and a revoked one.
fn unauthorized() -> Response {
    let mut response = Problem::new(Code::Unauthorized).detail("a valid token is required").into_response();
    let schemes = HeaderValue::from_static("Basic realm=\"Multistage\", charset=\"UTF-8\", Bearer");
    response.headers_mut().insert(header::WWW_AUTHENTICATE, schemes);
    response
}

fn too_many(wait_s: u64) -> Response {
    let mut response = Problem::new(Code::RateLimited).detail(format!("try again in {wait_s} s")).into_response();
    response.headers_mut().insert(header::RETRY_AFTER, HeaderValue::from(wait_s));
    response
}
