//! The options that clients of NodeODM can set, and what they are to the engine. An option that is not listed here is
//! dropped, as NodeODM does: its clients keep presets for other engines.

use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::http::problem::{Code, Problem};
use crate::pipeline::ReconstructionOptions;

/// What an option may be.
enum Kind {
    Bool,
    Int {
        min: i64,
        max: i64,
    },
    Float {
        min: f64,
        max: f64,
    },
    /// One of these names, which is also what the engine takes.
    Name(&'static [&'static str]),
    /// One of these names, each for a number.
    Size(&'static [(&'static str, i64)]),
}

struct NodeOption {
    name: &'static str,
    kind: Kind,
    help: &'static str,
    /// Where it stands among the engine's options.
    path: &'static [&'static str],
}

const OPTIONS: &[NodeOption] = &[
    NodeOption {
        name: "feature-quality",
        kind: Kind::Size(&[("ultra", 6400), ("high", 3200), ("medium", 2000), ("low", 1280), ("lowest", 800)]),
        help: "The length that the long side of photographs is shrunk to before features are sought: 6400, 3200, 2000, 1280 or 800 \
               pixels. Time and memory grow with its square.",
        path: &["intake", "max_long_side_px"],
    },
    NodeOption {
        name: "max-num-features",
        kind: Kind::Int { min: 100, max: 1_000_000 },
        help: "The most features kept of a photograph, those of the largest scales.",
        path: &["features", "max_features"],
    },
    NodeOption {
        name: "iterations",
        kind: Kind::Int { min: 1, max: 10 },
        help: "Rounds of adding cameras and points to the coarse model.",
        path: &["iterations"],
    },
    NodeOption {
        name: "refine",
        kind: Kind::Bool,
        help: "Whether the final model is adjusted as a whole.",
        path: &["refine", "enabled"],
    },
    NodeOption {
        name: "look-alikes",
        kind: Kind::Bool,
        help: "Whether places that look alike, such as equal houses along a street, are kept apart.",
        path: &["coarse", "look_alikes", "enabled"],
    },
    NodeOption {
        name: "principal-point",
        kind: Kind::Name(&["auto", "estimated", "middle"]),
        help: "Whether the point that a lens looks at is estimated or taken to be the middle of the picture.",
        path: &["coarse", "mapper", "intrinsics", "principal_point"],
    },
    NodeOption {
        name: "default-focal",
        kind: Kind::Float { min: 0.2, max: 9.0 },
        help: "The focal length, in units of a photograph's long side, to start from where nothing is known of the camera.",
        path: &["intake", "default_focal"],
    },
];

/// An option as `/options` lists it, its value always text.
#[derive(Serialize)]
pub(super) struct Description {
    name: &'static str,
    r#type: &'static str,
    value: String,
    domain: Value,
    help: &'static str,
}

/// An option that a task has.
#[derive(Serialize)]
pub(super) struct Chosen {
    name: &'static str,
    value: Value,
}

/// Why an option was refused, as these clients read it.
#[derive(Serialize)]
struct Refused {
    name: &'static str,
    error: String,
}

impl NodeOption {
    /// Where it stands, as a JSON pointer.
    fn pointer(&self) -> String {
        self.path.iter().map(|part| format!("/{part}")).collect()
    }

    /// Its value among the engine's options, as its clients know it.
    fn value_in(&self, options: &Value) -> Option<Value> {
        let value = options.pointer(&self.pointer())?;
        match self.kind {
            Kind::Size(sizes) => {
                let named = sizes.iter().find(|(_, size)| value.as_i64() == Some(*size));
                named.map(|(name, _)| json!(name))
            }
            _ => Some(value.clone()),
        }
    }

    /// A value as sent, which may be text, as the engine takes it.
    fn parse(&self, value: &Value) -> Result<Value, String> {
        let text = value.as_str().map_or_else(|| value.to_string(), |text| text.trim().to_owned());
        match self.kind {
            Kind::Bool => match text.to_ascii_lowercase().as_str() {
                "true" | "1" => Ok(json!(true)),
                "false" | "0" => Ok(json!(false)),
                _ => Err("must be true or false".to_owned()),
            },
            Kind::Int { min, max } => match text.parse::<i64>() {
                Ok(number) if (min..=max).contains(&number) => Ok(json!(number)),
                _ => Err(format!("must be a whole number from {min} to {max}")),
            },
            Kind::Float { min, max } => match text.parse::<f64>() {
                Ok(number) if (min..=max).contains(&number) => Ok(json!(number)),
                _ => Err(format!("must be a number from {min} to {max}")),
            },
            Kind::Name(names) if names.contains(&text.as_str()) => Ok(json!(text)),
            Kind::Name(names) => Err(format!("must be one of {}", names.join(", "))),
            Kind::Size(sizes) => match sizes.iter().find(|(name, _)| *name == text) {
                Some((_, size)) => Ok(json!(size)),
                None => Err(format!(
                    "must be one of {}",
                    sizes.iter().map(|(name, _)| *name).collect::<Vec<_>>().join(", ")
                )),
            },
        }
    }

    fn describe(&self, defaults: &Value) -> Description {
        let (r#type, domain) = match self.kind {
            Kind::Bool => ("bool", json!("bool")),
            Kind::Int { min, max } => ("int", json!(format!("integer: {min} <= x <= {max}"))),
            Kind::Float { min, max } => ("float", json!(format!("float: {min} <= x <= {max}"))),
            Kind::Name(names) => ("enum", json!(names)),
            Kind::Size(sizes) => ("enum", json!(sizes.iter().map(|(name, _)| name).collect::<Vec<_>>())),
        };
        let default = self.value_in(defaults).unwrap_or_default();
        let value = default.as_str().map_or_else(|| default.to_string(), str::to_owned);
        Description { name: self.name, r#type, value, domain, help: self.help }
    }
}

/// Every option with its default.
pub(super) fn descriptions() -> Vec<Description> {
    let defaults = serde_json::to_value(ReconstructionOptions::default()).unwrap_or_default();
    OPTIONS.iter().map(|option| option.describe(&defaults)).collect()
}

/// The options of a job that its clients know.
pub(super) fn chosen(engine: &Value) -> Vec<Chosen> {
    OPTIONS
        .iter()
        .filter_map(|option| option.value_in(engine).map(|value| Chosen { name: option.name, value }))
        .collect()
}

/// The engine's options out of what a client sent: a list of `{"name": ..., "value": ...}`, possibly as text.
pub(super) fn read(sent: &Value) -> Result<Value, Problem> {
    let not_a_list = || Problem::new(Code::InvalidOptions).detail("options must be a JSON list of names and values");
    let parsed: Value;
    let list = match sent {
        Value::Null => return Ok(json!({})),
        Value::String(text) if text.trim().is_empty() => return Ok(json!({})),
        Value::String(text) => {
            parsed = serde_json::from_str(text).map_err(|_| not_a_list())?;
            parsed.as_array()
        }
        other => other.as_array(),
    }
    .ok_or_else(not_a_list)?;
    let (mut engine, mut refused) = (json!({}), Vec::new());
    for entry in list {
        let named = entry["name"].as_str().ok_or_else(not_a_list)?;
        let Some(option) = OPTIONS.iter().find(|option| option.name == named) else { continue };
        match option.parse(&entry["value"]) {
            Ok(value) => put(&mut engine, option.path, value),
            Err(error) => refused.push(Refused { name: option.name, error }),
        }
    }
    if refused.is_empty() {
        return Ok(engine);
    }
    Err(Problem::new(Code::InvalidOptions).detail(json!(refused)))
}

fn put(engine: &mut Value, path: &[&str], value: Value) {
    let mut at = engine;
    for part in path {
        if !at.is_object() {
            *at = Value::Object(Map::new());
        }
        at = &mut at[*part];
    }
    *at = value;
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn sent(list: Value) -> Value {
        read(&Value::String(list.to_string())).unwrap()
    }

    #[test]
    fn every_option_is_one_of_the_engine_and_its_bounds_are_taken() {
        let defaults = serde_json::to_value(ReconstructionOptions::default()).unwrap();
        for (option, described) in OPTIONS.iter().zip(descriptions()) {
            assert_ne!(described.value, "null", "{} stands nowhere", option.name);
            let extremes = match option.kind {
                Kind::Bool => vec![json!("true"), json!(false)],
                Kind::Int { min, max } => vec![json!(min), json!(max.to_string())],
                Kind::Float { min, max } => vec![json!(min), json!(max)],
                Kind::Name(names) => names.iter().map(|name| json!(name)).collect(),
                Kind::Size(sizes) => sizes.iter().map(|(name, _)| json!(name)).collect(),
            };
            for value in extremes {
                let engine = sent(json!([{"name": option.name, "value": value}]));
                ReconstructionOptions::from_json(&engine).unwrap();
                let back = option.value_in(&engine).unwrap();
                assert_eq!(back.to_string().trim_matches('"'), value.to_string().trim_matches('"'));
                assert_eq!(
                    back.is_string(),
                    option.value_in(&defaults).unwrap().is_string(),
                    "{} is typed",
                    option.name
                );
            }
        }
    }

    #[test]
    fn unknown_names_are_dropped_and_bad_values_named() {
        let engine = sent(json!([
            {"name": "dsm", "value": true}, {"name": "iterations", "value": "3"}, {"name": "refine", "value": "False"},
        ]));
        assert_eq!(engine, json!({"iterations": 3, "refine": {"enabled": false}}));
        assert_eq!(
            json!(chosen(&engine)),
            json!([{"name": "iterations", "value": 3}, {"name": "refine", "value": false}])
        );
        for (list, bad) in [
            (json!([{"name": "iterations", "value": 11}, {"name": "refine", "value": "x"}]), "iterations"),
            (json!([{"name": "iterations"}]), "iterations"),
            (json!([{"name": "default-focal", "value": "NaN"}]), "default-focal"),
            (json!([{"name": "feature-quality", "value": 3200}]), "feature-quality"),
            (json!([{"value": 3}]), "list"),
            (json!([7]), "list"),
            (json!({"iterations": 3}), "list"),
            (json!("["), "list"),
        ] {
            let problem = read(&Value::String(list.to_string())).unwrap_err();
            assert!(problem.sentence().contains(bad), "{list}: {}", problem.sentence());
        }
        assert_eq!(read(&Value::Null).unwrap(), json!({}));
        assert_eq!(read(&json!("")).unwrap(), json!({}));
    }
}
