//! Holds the source to its layers: a module uses itself and modules below it, and the pure core stays free of files, clock,
//! environment, database and async. Code in `#[cfg(test)]` items is left out: tests may look up.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// The layers, top first. A layer may use those after it.
const LAYERS: &[&str] = &[
    "cli",
    "http",
    "jobs",
    "config",
    "pipeline",
    "store",
    "formats",
    "synthetic",
    "add_points",
    "add_cameras",
    "coarse",
    "bundle",
    "matching",
    "features",
    "ransac",
    "solvers",
    "scene",
    "geometry",
    "camera",
    "math",
];

/// The first layer of the pure core.
const PURE_FROM: &str = "synthetic";

/// What the pure core must not touch, as path prefixes.
const IMPURE: &[&[&str]] = &[
    &["std", "fs"],
    &["std", "env"],
    &["std", "time"],
    &["std", "net"],
    &["std", "process"],
    &["std", "thread"],
    &["tokio"],
    &["sqlx"],
    &["axum"],
];

/// The only layer that may use `synthetic`: the engine never sees an invented scene.
const USERS_OF_SYNTHETIC: &[&str] = &["cli", "synthetic"];

#[test]
fn the_source_keeps_to_its_layers() {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let mut files = Vec::new();
    collect(&root, &mut files);
    files.sort();
    assert!(files.len() > 20, "found only {} source files under {}", files.len(), root.display());
    let mut violations = Vec::new();
    for file in &files {
        let source = std::fs::read_to_string(file).expect("source files are readable UTF-8");
        let relative = file.strip_prefix(&root).expect("collected below the root");
        for violation in check(&module_of(relative), &source) {
            violations.push(format!("src/{}: {violation}", relative.display()));
        }
    }
    assert!(violations.is_empty(), "\n{}", violations.join("\n"));
}

#[test]
fn every_module_has_a_layer() {
    let source = include_str!("../src/lib.rs");
    let tokens = tokenize(source);
    let declared: BTreeSet<&str> =
        tokens.windows(3).filter(|w| w[0] == "mod" && w[2] == ";").map(|w| w[1].as_str()).collect();
    let unknown: Vec<_> = declared.iter().filter(|name| !LAYERS.contains(name)).collect();
    assert!(!declared.is_empty() && unknown.is_empty(), "modules without a place among the layers: {unknown:?}");
}

#[test]
fn upward_imports_are_found() {
    let found = |source: &str| check(&["coarse".into(), "model".into()], source).len();
    assert_eq!(found("use crate::bundle::Problem; use crate::coarse::select; use super::select; use std::fmt;"), 0);
    assert_eq!(found("use crate::add_cameras::x;"), 1);
    assert_eq!(found("use crate::{math::Rng, pipeline::{Context, Stage}, jobs};"), 3);
    assert_eq!(found("pub(crate) use crate::formats;"), 1);
    assert_eq!(found("fn f() -> crate::store::Key { let x = crate::math::f(crate::http::g()); x }"), 2);
    assert_eq!(found("fn f<'a>() -> impl Fn() + use<'a> { crate::store::key }"), 1);
    assert_eq!(found("use super::super::pipeline::Context;"), 1, "super may reach another layer through the root");
    assert_eq!(found("use super::super::bundle::Problem;"), 0);
    assert_eq!(found("mod inner { use super::super::super::jobs::State; use super::super::select; }"), 1);
    assert_eq!(found("use crate::*;"), 1, "a glob of the root hides what is used");
    assert_eq!(found("use crate as root;"), 1);
    assert_eq!(found("use crate::synthetic::Scene;"), 1);
    assert_eq!(found("use crate::nowhere::X;"), 1, "a module that has no layer");
}

#[test]
fn impurity_is_found() {
    let core = |source: &str| check(&["matching".into()], source).len();
    assert_eq!(core("use std::{fmt, fs::File, io::{self, Read}};"), 1);
    assert_eq!(core("fn f() { let t = std::time::Instant::now(); ::std::env::var(name); }"), 2);
    assert_eq!(core("use tokio::sync::Mutex; use sqlx; use axum::Router;"), 3);
    assert_eq!(core("use std as s;"), 1, "an alias of std hides what is used");
    assert_eq!(check(&["store".into()], "use std::fs; use tokio::fs as f;").len(), 0);
}

#[test]
fn text_and_tests_are_not_code() {
    let found = |source: &str| check(&["math".into()], source);
    assert!(found("//! See crate::jobs.\n/* crate::http /* nested */ crate::cli */ // use std::fs;\n").is_empty());
    assert!(
        found(r###"const A: &str = "use crate::jobs; \" crate::cli"; const B: &str = r#"crate::http " std::fs"#;"###)
            .is_empty()
    );
    assert!(
        found("#[cfg(test)]\nmod tests { use crate::synthetic::Scene; fn f() { std::fs::read(\"}\"); } }").is_empty()
    );
    assert!(found("#[cfg(test)] use crate::synthetic::Scene;").is_empty());
    assert!(found("#[cfg(test)] #[allow(x)] fn f(a: [u8; 2]) -> B { crate::jobs::run(';') }").is_empty());
    let after = "#[cfg(test)] mod tests;\n fn f<'a>(x: &'a str, c: char) -> bool { c == '\"' } use crate::jobs::State;";
    assert_eq!(found(after).len(), 1, "code after a test item counts");
    assert_eq!(found("#[cfg(not(test))] use crate::jobs::State;").len(), 1);
    assert!(check(&["formats".into()], "use crate::synthetic::Scene;").len() == 1, "formats is engine");
    assert!(check(&["cli".into()], "use crate::synthetic::Scene; use crate::jobs;").is_empty());
}

fn collect(folder: &Path, files: &mut Vec<PathBuf>) {
    for entry in std::fs::read_dir(folder).expect("a readable folder") {
        let path = entry.expect("a readable entry").path();
        if path.is_dir() {
            collect(&path, files);
        } else if path.extension().is_some_and(|e| e == "rs") {
            files.push(path);
        }
    }
}

/// `coarse/model/next.rs` is the module coarse::model::next; `coarse/mod.rs` is coarse; lib.rs and main.rs are the root.
fn module_of(relative: &Path) -> Vec<String> {
    let mut parts: Vec<String> = relative.iter().map(|p| p.to_string_lossy().into_owned()).collect();
    let file = parts.pop().expect("a file has a name");
    let stem = file.trim_end_matches(".rs");
    if !matches!(stem, "mod" | "lib" | "main") {
        parts.push(stem.to_owned());
    }
    parts
}

/// The violations in one file, as sentences.
fn check(module: &[String], source: &str) -> Vec<String> {
    // The root declares the layers and main.rs calls the command line; neither is a layer.
    let Some(own) = module.first() else { return Vec::new() };
    // Tests kept in a file of their own.
    if module.last().is_some_and(|m| m == "tests") {
        return Vec::new();
    }
    let rank = |layer: &str| LAYERS.iter().position(|l| *l == layer);
    let Some(own_rank) = rank(own) else { return vec![format!("`{own}` has no place among the layers")] };
    let pure = own_rank >= rank(PURE_FROM).expect("it is a layer");
    let mut violations = Vec::new();
    for path in paths(module, &tokenize(source)) {
        let names: Vec<&str> = path.iter().map(String::as_str).collect();
        match names.as_slice() {
            ["crate", "*"] | ["crate"] => violations.push("imports the crate's root as a whole".to_owned()),
            ["crate", layer, ..] => match rank(layer) {
                None => violations.push(format!("`{}`: `{layer}` has no place among the layers", path.join("::"))),
                Some(_) if *layer == "synthetic" && !USERS_OF_SYNTHETIC.contains(&own.as_str()) => {
                    violations.push(format!("`{}`: the engine must not use `synthetic`", path.join("::")));
                }
                Some(r) if r < own_rank => {
                    violations.push(format!("`{}`: `{layer}` stands above `{own}`", path.join("::")));
                }
                Some(_) => {}
            },
            ["std"] | ["std", "*"] if pure => violations.push("imports `std` as a whole".to_owned()),
            _ if pure && IMPURE.iter().any(|banned| names.starts_with(banned)) => {
                violations.push(format!("`{}` in the pure core", path.join("::")));
            }
            _ => {}
        }
    }
    violations
}

/// Identifiers, `::`, and single punctuation characters; comments, literals and lifetimes left out.
fn tokenize(source: &str) -> Vec<String> {
    let bytes = source.as_bytes();
    let mut tokens = Vec::new();
    let mut i = 0;
    let word = |b: u8| b.is_ascii_alphanumeric() || b == b'_' || b >= 0x80;
    while i < bytes.len() {
        let rest = &bytes[i..];
        match rest[0] {
            b'/' if rest.starts_with(b"//") => i += rest.iter().position(|b| *b == b'\n').unwrap_or(rest.len()),
            b'/' if rest.starts_with(b"/*") => {
                let mut depth = 0;
                while i < bytes.len() {
                    if bytes[i..].starts_with(b"/*") {
                        depth += 1;
                        i += 2;
                    } else if bytes[i..].starts_with(b"*/") {
                        depth -= 1;
                        i += 2;
                        if depth == 0 {
                            break;
                        }
                    } else {
                        i += 1;
                    }
                }
            }
            b'"' => i += quoted(rest, b'"'),
            // A character literal closes two or three bytes on, or is escaped, or is not ASCII; a lifetime is none of these.
            b'\''
                if rest.get(1) == Some(&b'\\')
                    || rest.get(2) == Some(&b'\'')
                    || rest.get(1).is_some_and(|b| *b >= 0x80) =>
            {
                i += quoted(rest, b'\'');
            }
            b'\'' => {
                i += 1;
                while i < bytes.len() && word(bytes[i]) {
                    i += 1;
                }
            }
            b if word(b) => {
                let length = rest.iter().position(|b| !word(*b)).unwrap_or(rest.len());
                let text = &source[i..i + length];
                i += length;
                let raw = matches!(text, "r" | "br" | "cr");
                let hashes = bytes[i..].iter().take_while(|b| **b == b'#').count();
                if raw && bytes.get(i + hashes) == Some(&b'"') {
                    let close = format!("\"{}", "#".repeat(hashes));
                    let body = i + hashes + 1;
                    i = source[body..].find(&close).map_or(bytes.len(), |at| body + at + close.len());
                } else if !raw || hashes == 0 {
                    tokens.push(text.to_owned());
                }
            }
            b':' if rest.starts_with(b"::") => {
                tokens.push("::".to_owned());
                i += 2;
            }
            b => {
                if !b.is_ascii_whitespace() {
                    tokens.push((b as char).to_string());
                }
                i += 1;
            }
        }
    }
    tokens
}

/// Length of the literal that `bytes` starts with, up to and with the closing `quote`.
fn quoted(bytes: &[u8], quote: u8) -> usize {
    let mut i = 1;
    while i < bytes.len() && bytes[i] != quote {
        i += if bytes[i] == b'\\' { 2 } else { 1 };
    }
    (i + 1).min(bytes.len())
}

/// Every path in the tokens, `use` groups spread out and `self` and `super` resolved, so that each starts with `crate` or the
/// name of an external crate.
fn paths(module: &[String], tokens: &[String]) -> Vec<Vec<String>> {
    let mut found = Vec::new();
    // Inline modules we are in: name and the brace depth outside.
    let mut inline: Vec<(String, usize)> = Vec::new();
    let mut depth = 0;
    let mut i = 0;
    while i < tokens.len() {
        match tokens[i].as_str() {
            "#" if tokens[i..].iter().take(7).map(String::as_str).eq(["#", "[", "cfg", "(", "test", ")", "]"]) => {
                i = after_item(tokens, i + 7);
                continue;
            }
            "mod" if tokens.get(i + 2).is_some_and(|t| t == "{") => {
                inline.push((tokens[i + 1].clone(), depth));
                i += 2;
                continue;
            }
            "{" => depth += 1,
            "}" => {
                depth = depth.saturating_sub(1);
                if inline.last().is_some_and(|(_, outside)| *outside == depth) {
                    inline.pop();
                }
            }
            // Not the captures of a type, `impl Trait + use<..>`.
            "use" if tokens.get(i + 1).is_none_or(|t| t != "<") => {
                let here: Vec<String> =
                    module.iter().cloned().chain(inline.iter().map(|(name, _)| name.clone())).collect();
                let mut trees = Vec::new();
                i = use_tree(tokens, i + 1, &mut Vec::new(), &mut trees);
                found.extend(trees.into_iter().map(|path| resolve(&here, path)));
                continue;
            }
            name if is_name(name) && tokens.get(i + 1).is_some_and(|t| t == "::") => {
                let mut path = vec![name.to_owned()];
                i += 1;
                while tokens.get(i).is_some_and(|t| t == "::") && tokens.get(i + 1).is_some_and(|t| is_name(t)) {
                    path.push(tokens[i + 1].clone());
                    i += 2;
                }
                let here: Vec<String> =
                    module.iter().cloned().chain(inline.iter().map(|(name, _)| name.clone())).collect();
                found.push(resolve(&here, path));
                continue;
            }
            _ => {}
        }
        i += 1;
    }
    found
}

fn is_name(token: &str) -> bool {
    token.starts_with(|c: char| c.is_alphabetic() || c == '_')
}

/// The index after the item that starts at `i`: after its `;`, or after its braces, outside brackets and parentheses.
fn after_item(tokens: &[String], mut i: usize) -> usize {
    let mut nested = 0;
    while i < tokens.len() {
        match tokens[i].as_str() {
            "(" | "[" | "{" => nested += 1,
            ")" | "]" => nested -= 1,
            "}" => {
                nested -= 1;
                // The braces of a `use` group are followed by its semicolon.
                if nested == 0 && tokens.get(i + 1).is_none_or(|t| t != ";") {
                    return i + 1;
                }
            }
            ";" if nested == 0 => return i + 1,
            _ => {}
        }
        i += 1;
    }
    i
}

/// Reads the use tree at `i` below `prefix`, adds its paths, and gives the index after it.
fn use_tree(tokens: &[String], mut i: usize, prefix: &mut Vec<String>, found: &mut Vec<Vec<String>>) -> usize {
    let outer = prefix.len();
    while i < tokens.len() {
        match tokens[i].as_str() {
            "::" => i += 1,
            "{" => {
                i += 1;
                while i < tokens.len() && tokens[i] != "}" {
                    i = use_tree(tokens, i, prefix, found);
                    if tokens.get(i).is_some_and(|t| t == ",") {
                        i += 1;
                    }
                }
                prefix.truncate(outer);
                return i + 1;
            }
            // `as name` does not change what is used.
            "as" => i += 2,
            "," | "}" | ";" => break,
            name => {
                // In a group, `self` is the group's own prefix.
                if name != "self" || outer == 0 {
                    prefix.push(name.to_owned());
                }
                i += 1;
            }
        }
    }
    found.push(prefix.clone());
    prefix.truncate(outer);
    i
}

/// Turns a path that starts with `self` or `super` into one that starts with `crate`.
fn resolve(here: &[String], path: Vec<String>) -> Vec<String> {
    let ups = path.iter().take_while(|p| *p == "super" || *p == "self").filter(|p| *p == "super").count();
    match path.first().map(String::as_str) {
        Some("self" | "super") => {
            let kept = here.len().saturating_sub(ups);
            let rest = path.into_iter().skip_while(|p| p == "super" || p == "self");
            std::iter::once("crate".to_owned()).chain(here[..kept].iter().cloned()).chain(rest).collect()
        }
        _ => path,
    }
}
