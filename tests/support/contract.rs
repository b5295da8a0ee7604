//! `openapi.yaml` as something that answers can be held to: a validator of the part of JSON Schema that the document uses. It
//! panics at a keyword it does not know, so that nothing in the document goes unchecked by accident.

use serde_json::{Map, Value};

/// The document.
pub struct Contract(Value);

/// An operation of the document.
pub struct Operation {
    /// `get`, `post`, ...
    pub method: String,
    /// With its parameters in braces.
    pub path: String,
    value: Value,
}

impl Contract {
    pub fn load() -> Self {
        let text = include_str!("../../openapi.yaml");
        Self(serde_yaml_ng::from_str(text).expect("openapi.yaml is YAML"))
    }

    pub fn document(&self) -> &Value {
        &self.0
    }

    pub fn operations(&self) -> Vec<Operation> {
        let mut found = Vec::new();
        for (path, item) in self.0["paths"].as_object().expect("paths") {
            for (method, value) in item.as_object().expect("a path item") {
                if method != "parameters" {
                    found.push(Operation { method: method.clone(), path: path.clone(), value: value.clone() });
                }
            }
        }
        found
    }

    /// The operation that a request is; HEAD counts as GET.
    pub fn operation(&self, method: &str, path: &str) -> Option<Operation> {
        let method = if method == "HEAD" { "get".to_owned() } else { method.to_ascii_lowercase() };
        let fitting = self.operations().into_iter().filter(|op| op.method == method && fits(&op.path, path));
        // Of several, the one with the fewest parameters: `/outputs.zip` is no `/{path}`.
        fitting.min_by_key(|op| op.path.matches('{').count())
    }

    /// Panics unless the answer is one that the document describes.
    pub fn check(&self, operation: &Operation, status: u16, media_type: Option<&str>, body: &[u8]) {
        let what = format!("{} {} -> {status}", operation.method, operation.path);
        let responses = &operation.value["responses"];
        let response = match responses.get(status.to_string()) {
            Some(response) => response,
            None if status >= 400 => responses.get("default").unwrap_or_else(|| panic!("{what}: not documented")),
            None => panic!("{what}: not documented"),
        };
        let response = self.resolve(response);
        let Some(content) = response.get("content") else {
            assert!(body.is_empty(), "{what}: a body that is not documented");
            return;
        };
        let media_type = media_type.unwrap_or_else(|| panic!("{what}: no content type"));
        let media_type = media_type.split(';').next().unwrap_or("").trim();
        let content = content.as_object().expect("content");
        let schema = content.get(media_type).or_else(|| content.get("*/*"));
        let schema = &schema.unwrap_or_else(|| panic!("{what}: {media_type} is not documented"))["schema"];
        if media_type.ends_with("json") && !content.contains_key("*/*") {
            let value: Value = serde_json::from_slice(body)
                .unwrap_or_else(|error| panic!("{what}: {error}: {}", String::from_utf8_lossy(body)));
            self.validate(schema, &value, &what);
        }
    }

    /// Panics unless a value is as a named schema says.
    pub fn check_named(&self, schema: &str, value: &Value) {
        self.validate(&self.0["components"]["schemas"][schema], value, schema);
    }

    /// Panics unless every example of the document is as its schema says; how many there are.
    pub fn check_examples(&self) -> usize {
        let schemas = self.0["components"]["schemas"].as_object().expect("schemas");
        let mut found = 0;
        for (name, schema) in schemas {
            if let Some(example) = schema.get("example") {
                self.validate(schema, example, name);
                found += 1;
            }
        }
        found
    }

    fn resolve<'a>(&'a self, value: &'a Value) -> &'a Value {
        match value.get("$ref").and_then(Value::as_str) {
            Some(reference) => {
                let pointer = reference.strip_prefix('#').expect("a local reference");
                self.resolve(self.0.pointer(pointer).unwrap_or_else(|| panic!("{reference} leads nowhere")))
            }
            None => value,
        }
    }

    fn validate(&self, schema: &Value, value: &Value, at: &str) {
        if let Err(error) = self.violation(schema, value, at) {
            panic!("{error}\n{value:#}");
        }
    }

    fn violation(&self, schema: &Value, value: &Value, at: &str) -> Result<(), String> {
        let schema = self.resolve(schema).as_object().expect("a schema");
        for (keyword, rule) in schema {
            let holds = match keyword.as_str() {
                "type" => match rule {
                    Value::Array(kinds) => kinds.iter().any(|kind| is(value, kind)),
                    kind => is(value, kind),
                },
                "const" => value == rule,
                "enum" => rule.as_array().expect("enum").contains(value),
                "minimum" => value.as_f64().is_none_or(|n| n >= rule.as_f64().expect("minimum")),
                "maximum" => value.as_f64().is_none_or(|n| n <= rule.as_f64().expect("maximum")),
                "maxLength" => {
                    value.as_str().is_none_or(|s| s.chars().count() as u64 <= rule.as_u64().expect("maxLength"))
                }
                "minLength" => {
                    value.as_str().is_none_or(|s| s.chars().count() as u64 >= rule.as_u64().expect("minLength"))
                }
                "format" => value.as_str().is_none_or(|text| match rule.as_str() {
                    Some("uuid") => text.parse::<uuid::Uuid>().is_ok(),
                    Some("date-time") => text.parse::<jiff::Timestamp>().is_ok(),
                    Some("binary") => true,
                    other => panic!("{at}: unknown format {other:?}"),
                }),
                "oneOf" => {
                    let schemas = rule.as_array().expect("oneOf");
                    schemas.iter().filter(|schema| self.violation(schema, value, at).is_ok()).count() == 1
                }
                "items" => {
                    for (i, item) in value.as_array().into_iter().flatten().enumerate() {
                        self.violation(rule, item, &format!("{at}[{i}]"))?;
                    }
                    true
                }
                "required" => {
                    let empty = Map::new();
                    let object = value.as_object().unwrap_or(&empty);
                    let names = rule.as_array().expect("required").iter().map(|name| name.as_str().expect("a name"));
                    match names.into_iter().find(|name| !object.contains_key(*name)) {
                        Some(name) => return Err(format!("{at}: {name} is missing")),
                        None => true,
                    }
                }
                "properties" => {
                    for (name, schema) in rule.as_object().expect("properties") {
                        if let Some(inner) = value.get(name) {
                            self.violation(schema, inner, &format!("{at}.{name}"))?;
                        }
                    }
                    true
                }
                "additionalProperties" => {
                    let known = schema.get("properties").and_then(Value::as_object);
                    for (name, inner) in value.as_object().into_iter().flatten() {
                        if known.is_some_and(|known| known.contains_key(name)) {
                            continue;
                        }
                        match rule {
                            Value::Bool(false) => return Err(format!("{at}: {name} is not documented")),
                            rule => self.violation(rule, inner, &format!("{at}.{name}"))?,
                        }
                    }
                    true
                }
                // Patterns are of requests alone, where the service itself is asked; schemathesis reads them too.
                "description" | "default" | "example" | "pattern" | "contentMediaType" => true,
                other => panic!("{at}: the validator does not know the keyword {other}"),
            };
            if !holds {
                return Err(format!("{at}: {value} breaks {keyword}: {rule}"));
            }
        }
        Ok(())
    }
}

fn is(value: &Value, kind: &Value) -> bool {
    match kind.as_str().expect("a type") {
        "null" => value.is_null(),
        "boolean" => value.is_boolean(),
        "integer" => value.is_i64() || value.is_u64(),
        "number" => value.is_number(),
        "string" => value.is_string(),
        "array" => value.is_array(),
        "object" => value.is_object(),
        other => panic!("unknown type {other}"),
    }
}

/// Whether a path is one of a template; the parameter `path` takes the rest, slashes and all.
fn fits(template: &str, path: &str) -> bool {
    let mut parts = path.split('/');
    for wanted in template.split('/') {
        if wanted == "{path}" {
            return parts.next().is_some_and(|part| !part.is_empty());
        }
        match parts.next() {
            Some(part) if wanted == part || (wanted.starts_with('{') && !part.is_empty()) => {}
            _ => return false,
        }
    }
    parts.next().is_none()
}
