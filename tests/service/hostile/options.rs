//! Options of the wrong type, for the real engine.

use multistage::jobs::{Engine, PipelineEngine};
use serde_json::{Value, json};

#[test]
fn an_option_of_the_wrong_type_is_named() {
    let wrong = |options: Value| PipelineEngine.validate(&options).unwrap_err().join("; ");
    for (options, field) in [
        (json!({"iterations": "2"}), "iterations"),
        (json!({"iterations": 1.5}), "iterations"),
        (json!({"iterations": -1}), "iterations"),
        (json!({"iterations": 1e99}), "iterations"),
        (json!({"iterations": null}), "iterations"),
        (json!({"intake": 5}), "intake"),
        (json!({"intake": {"max_long_side_px": []}}), "intake.max_long_side_px"),
        (json!({"intake": {"max_megapixels": "x"}}), "intake.max_megapixels"),
        (json!({"coarse": {"enough_registered": true}}), "coarse.enough_registered"),
        (json!({"refine": {"enabled": 1}}), "refine.enabled"),
        (json!({"intake": {"camera": {"model": "SIMPLE_RADIAL", "params": ["a"]}}}), "intake.camera"),
        (json!({"nothing": 1}), "nothing"),
        (json!({"refine": {"nothing": 1}}), "refine"),
        (json!([1, 2]), "[0]"),
    ] {
        let said = wrong(options.clone());
        assert!(said.contains(field), "{options}: {said}");
    }
}

#[test]
fn every_option_refuses_a_list_and_a_text_by_name() {
    // Walks the defaults, so that an option made later is tried too.
    fn walk(at: &mut Vec<String>, value: &Value, tried: &mut usize) {
        if let Value::Object(fields) = value
            && !fields.is_empty()
        {
            for (name, inner) in fields {
                at.push(name.clone());
                walk(at, inner, tried);
                at.pop();
            }
            return;
        }
        for wrong in [json!("no such thing"), json!([["x"]])] {
            // What is optional or a list may take some of these; what counts is that the refusal names it.
            let options = at.iter().rev().fold(wrong, |inner, name| json!({ name: inner }));
            if let Err(errors) = PipelineEngine.validate(&options) {
                // Of an option with kinds, the option itself is named.
                let named = at.iter().rev().take(2).any(|name| errors.join(";").contains(name.as_str()));
                assert!(named, "{options}: {errors:?}");
                *tried += 1;
            }
        }
    }
    let defaults = serde_json::to_value(multistage::pipeline::ReconstructionOptions::default()).unwrap();
    let mut tried = 0;
    walk(&mut Vec::new(), &defaults, &mut tried);
    assert!(tried > 60, "{tried}");
}
