//! What nobody in good faith sends: each is refused with a problem that says what is wrong, quickly and in little
//! memory, and the service goes on. Never an answer of the 500s.

mod archives;
mod multipart;
mod options;
mod pictures;
