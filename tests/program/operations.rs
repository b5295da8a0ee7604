//! What those who run the service do with it: stop and start it, look after its directory, copy it, read its log and figures.

mod directory;
mod migrations;
mod process;
