//! Options of a run from a JSON file and from `--set a.b=value`, over the defaults.
//!
//! The defaults, as JSON, say which names there are, so that a wrong name or value is answered with the full name of
//! the option.

use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::{Map, Value};

/// The defaults with `file` over them and then each `name.of.option=value` of `sets`, in order. A value is JSON, or else
/// taken as a text.
///
/// # Errors
/// A message that names the option.
pub fn merged<T>(file: Option<Value>, sets: &[String]) -> Result<T, String>
where
    T: Default + Serialize + DeserializeOwned,
{
    let defaults = serde_json::to_value(T::default()).map_err(|error| error.to_string())?;
    let mut options = defaults.clone();
    let mut changes = Vec::new();
    if let Some(file) = file {
        if !file.is_object() {
            return Err("the options must be a JSON object".into());
        }
        leaves(&file, &defaults, "", &mut changes);
    }
    for set in sets {
        let (name, value) = set.split_once('=').ok_or_else(|| format!("--set {set}: write it as name=value"))?;
        let value = serde_json::from_str(value).unwrap_or_else(|_| Value::String(value.to_owned()));
        leaves(&nested(name, value), &defaults, "", &mut changes);
    }
    for (name, value) in changes {
        put(&mut options, &defaults, &name, value)?;
        // Checked change by change, so that the message can say which one was wrong.
        serde_json::from_value::<T>(options.clone()).map_err(|error| format!("option {name}: {error}"))?;
    }
    serde_json::from_value(options).map_err(|error| error.to_string())
}

/// `{"a": {"b": value}}` for `a.b`.
fn nested(name: &str, value: Value) -> Value {
    name.rsplit('.').fold(value, |inner, part| Value::Object(Map::from_iter([(part.to_owned(), inner)])))
}

/// The single options that `change` sets. What is an object without entries in the defaults, such as a table by file name,
/// is one option, and so is one tagged with its kind, such as a loss: another kind has other entries.
fn leaves(change: &Value, defaults: &Value, prefix: &str, found: &mut Vec<(String, Value)>) {
    match (change, defaults) {
        (Value::Object(entries), Value::Object(known)) if !known.is_empty() && !known.contains_key("kind") => {
            for (name, value) in entries {
                let full = if prefix.is_empty() { name.clone() } else { format!("{prefix}.{name}") };
                leaves(value, known.get(name).unwrap_or(&Value::Null), &full, found);
            }
        }
        _ => found.push((prefix.to_owned(), change.clone())),
    }
}

fn put(options: &mut Value, defaults: &Value, name: &str, value: Value) -> Result<(), String> {
    let (mut place, mut known) = (options, defaults);
    for part in name.split('.') {
        let Some(below) = known.get(part) else {
            let names: Vec<&str> = known.as_object().into_iter().flat_map(Map::keys).map(String::as_str).collect();
            return Err(format!("option {name}: there is no `{part}`, but {}", names.join(", ")));
        };
        known = below;
        place = place.get_mut(part).ok_or_else(|| format!("option {name}: it is set in two ways"))?;
    }
    *place = value;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use serde::Deserialize;
    use serde_json::json;
    use std::collections::BTreeMap;

    #[derive(Debug, PartialEq, Serialize, Deserialize, Default)]
    #[serde(default, deny_unknown_fields)]
    struct Outer {
        rounds: u32,
        inner: Inner,
        cameras: BTreeMap<String, f64>,
        known: Option<Inner>,
        loss: Loss,
    }

    #[derive(Debug, PartialEq, Serialize, Deserialize, Default)]
    #[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
    enum Loss {
        #[default]
        Trivial,
        Huber {
            scale: f64,
        },
    }

    #[derive(Debug, PartialEq, Serialize, Deserialize, Default)]
    #[serde(default, deny_unknown_fields)]
    struct Inner {
        ratio: f64,
        name: String,
    }

    fn sets(sets: &[&str]) -> Result<Outer, String> {
        merged(None, &sets.iter().map(|set| (*set).to_owned()).collect::<Vec<_>>())
    }

    #[test]
    fn file_and_sets_go_over_the_defaults() {
        let file = json!({"rounds": 1, "inner": {"ratio": 0.5}, "cameras": {"a.jpg": 2.0}, "known": {"ratio": 3.0}});
        let options: Outer = merged(Some(file), &["rounds=4".into(), "inner.name=old".into()]).unwrap();
        assert_eq!(options.rounds, 4);
        assert_eq!(options.inner, Inner { ratio: 0.5, name: "old".into() });
        assert_eq!(options.cameras["a.jpg"], 2.0);
        assert_eq!(options.known, Some(Inner { ratio: 3.0, name: String::new() }));
        assert_eq!(sets(&[]).unwrap(), Outer::default());
    }

    #[test]
    fn a_tagged_value_is_set_as_a_whole() {
        let options = sets(&[r#"loss={"kind": "huber", "scale": 2.0}"#]).unwrap();
        assert_eq!(options.loss, Loss::Huber { scale: 2.0 });
        let file = json!({"loss": {"kind": "huber", "scale": 3.0}});
        assert_eq!(merged::<Outer>(Some(file), &[]).unwrap().loss, Loss::Huber { scale: 3.0 });
        let message = sets(&["loss.kind=huber"]).unwrap_err();
        assert!(message.starts_with("option loss: missing field `scale`"), "{message}");
    }

    #[test]
    fn mistakes_are_named() {
        assert_eq!(sets(&["rounds"]).unwrap_err(), "--set rounds: write it as name=value");
        assert_eq!(
            sets(&["inner.ration=1"]).unwrap_err(),
            "option inner.ration: there is no `ration`, but name, ratio"
        );
        assert_eq!(sets(&["rounds.x=1"]).unwrap_err(), "option rounds: invalid type: map, expected u32");
        let message = sets(&["inner.ratio=wide"]).unwrap_err();
        assert!(message.starts_with("option inner.ratio: invalid type: string \"wide\""), "{message}");
        assert!(merged::<Outer>(Some(json!([1])), &[]).is_err());
        let message = merged::<Outer>(Some(json!({"known": {"ratio": "x"}})), &[]).unwrap_err();
        assert!(message.starts_with("option known: "), "{message}");
    }
}
