#![no_main]

#[path = "../../tests/service/parsers/targets.rs"]
mod targets;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| targets::run("form", bytes));
