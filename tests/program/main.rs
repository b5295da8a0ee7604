//! The real program, and what happens to it: it is started and stopped, cancelled and killed, loses power and its
//! clock, its disk is full or broken, and programs of others hold it to its contract.

#![allow(clippy::unwrap_used)]

#[path = "../support/program.rs"]
mod program;
#[path = "../support/service.rs"]
mod service;

mod clock;
mod contract;
mod crashes;
mod disk;
mod interrupted;
mod kills;
mod operations;
mod power_loss;
mod resend;
mod token;
mod webhook_tls;
