//! What a process did to files, as strace recorded it, and what a disk holds that lost its power in the middle.
//!
//! A disk keeps what was synced: the bytes of a file that were written before a sync of it began, the entries of a
//! folder likewise. Of the rest it keeps nothing, or any part of it.

use std::collections::{BTreeMap, HashMap};
use std::path::Path;

/// What strace is to record; positions of files are followed, so whatever moves them belongs to it.
pub const CALLS: &str = "openat,open,close,lseek,write,pwrite64,writev,ftruncate,fsync,fdatasync,rename,renameat,renameat2,link,\
                         linkat,unlink,unlinkat,mkdir,mkdirat,rmdir,sendto,sendmsg";

/// One line of the record.
#[derive(Debug)]
pub struct Line {
    process: String,
    /// The name of the call and its arguments; those of a call that is not over yet as far as they are known.
    call: String,
    arguments: Vec<String>,
    /// What it gave; none where it has only begun.
    result: Option<i64>,
    /// Whether an earlier line told of its begin.
    is_end: bool,
}

impl Line {
    /// Bytes of all texts among the arguments.
    pub fn bytes(&self) -> Vec<u8> {
        self.arguments.iter().flat_map(|argument| text(argument)).collect()
    }

    /// Whether it begins to send bytes, maybe to a client, who may have them before the call is over.
    pub fn begins_to_send(&self) -> bool {
        !self.is_end && matches!(&*self.call, "write" | "writev" | "sendto" | "sendmsg")
    }
}

/// The bytes between the quotes of an argument, which are all written in hexadecimal.
fn text(argument: &str) -> Vec<u8> {
    let Some(quoted) = argument.split('"').nth(1) else { return Vec::new() };
    quoted.split("\\x").skip(1).map(|byte| u8::from_str_radix(byte, 16).unwrap()).collect()
}

/// Reads a record.
pub fn parse(record: &str) -> Vec<Line> {
    let mut begun = HashMap::<String, String>::new();
    let mut lines = Vec::new();
    for line in record.lines() {
        let Some((process, rest)) = line.split_once(char::is_whitespace) else { continue };
        let (process, rest) = (process.to_owned(), rest.trim_start());
        let is_end = rest.starts_with("<... ");
        let whole = if let Some(start) = rest.strip_suffix("<unfinished ...>") {
            begun.insert(process.clone(), start.to_owned());
            format!("{}) = ?", start.trim_end().trim_end_matches(','))
        } else if let Some(end) = rest.strip_prefix("<... ") {
            let end = end.split_once(" resumed>").unwrap().1;
            begun.remove(&process).unwrap() + end
        } else {
            rest.to_owned()
        };
        let Some((call, rest)) = whole.split_once('(') else { continue };
        let Some((arguments, result)) = rest.rsplit_once(") ").and_then(|(a, r)| Some((a, r.rsplit_once("= ")?.1)))
        else {
            continue;
        };
        let result = result.split(' ').next().unwrap().parse().ok();
        let arguments = arguments.split(", ").map(|argument| argument.trim().to_owned()).collect();
        lines.push(Line { process, call: call.to_owned(), arguments, result, is_end });
    }
    lines
}

#[derive(Clone, Debug)]
enum Change {
    Write(u64, Vec<u8>),
    Cut(u64),
    Entry(String, Option<usize>),
}

/// A file or a folder.
#[derive(Default)]
struct Node {
    is_folder: bool,
    /// Durable.
    bytes: Vec<u8>,
    entries: BTreeMap<String, usize>,
    /// Of a folder, as the process sees it.
    now: BTreeMap<String, usize>,
    length: u64,
    /// Not durable yet, each with its number.
    pending: Vec<(u64, Change)>,
}

impl Node {
    fn apply(&mut self, change: Change) {
        match change {
            Change::Write(at, bytes) => {
                let end = at as usize + bytes.len();
                self.bytes.resize(self.bytes.len().max(end), 0);
                self.bytes[at as usize..end].copy_from_slice(&bytes);
            }
            Change::Cut(length) => self.bytes.resize(length as usize, 0),
            Change::Entry(name, Some(node)) => drop(self.entries.insert(name, node)),
            Change::Entry(name, None) => drop(self.entries.remove(&name)),
        }
    }
}

/// A data directory on a disk that may lose its power.
pub struct Disk {
    root: String,
    nodes: Vec<Node>,
    /// Open files: what, and the position.
    open: HashMap<i64, (usize, u64)>,
    /// Changes so far, at the begin of a sync, by process.
    syncing: HashMap<String, u64>,
    changes: u64,
    /// Whether the syncs of folders count.
    folders_sync: bool,
}

impl Disk {
    /// An empty folder at `root`.
    pub fn new(root: &Path, folders_sync: bool) -> Self {
        let nodes = vec![Node { is_folder: true, ..Node::default() }];
        let root = root.to_str().unwrap().to_owned();
        Self { root, nodes, open: HashMap::new(), syncing: HashMap::new(), changes: 0, folders_sync }
    }

    fn change(&mut self, node: usize, change: Change) {
        self.changes += 1;
        self.nodes[node].pending.push((self.changes, change));
    }

    /// The folder of a path and its last name there; a path beyond the root is none of ours.
    fn place(&self, folder: &str, path: &str) -> Option<(usize, String)> {
        let path = String::from_utf8(text(path)).unwrap();
        let (mut node, rest) = match path.strip_prefix(&self.root) {
            Some(rest) => (0, rest.to_owned()),
            None if path.starts_with('/') => return None,
            None => (self.open.get(&folder.parse().ok()?)?.0, path),
        };
        let mut names: Vec<&str> = rest.split('/').filter(|name| !name.is_empty()).collect();
        let last = names.pop().unwrap_or("");
        for name in names {
            node = *self.nodes[node].now.get(name)?;
        }
        Some((node, last.to_owned()))
    }

    fn find(&self, place: &(usize, String)) -> Option<usize> {
        if place.1.is_empty() { Some(place.0) } else { self.nodes[place.0].now.get(&place.1).copied() }
    }

    fn enter(&mut self, (folder, name): (usize, String), node: Option<usize>) {
        match node {
            Some(node) => self.nodes[folder].now.insert(name.clone(), node),
            None => self.nodes[folder].now.remove(&name),
        };
        self.change(folder, Change::Entry(name, node));
    }

    fn make(&mut self, place: (usize, String), is_folder: bool) -> usize {
        self.nodes.push(Node { is_folder, ..Node::default() });
        let node = self.nodes.len() - 1;
        self.enter(place, Some(node));
        node
    }

    fn write(&mut self, node: usize, at: u64, bytes: Vec<u8>) {
        let length = &mut self.nodes[node].length;
        *length = (*length).max(at + bytes.len() as u64);
        self.change(node, Change::Write(at, bytes));
    }

    /// One line of the record.
    pub fn take(&mut self, line: &Line) {
        let arguments: Vec<&str> = line.arguments.iter().map(String::as_str).collect();
        let is_sync = matches!(&*line.call, "fsync" | "fdatasync");
        if line.call == "close" {
            // Its number is free from the begin, and another thread may have it again before the end is recorded.
            if !line.is_end
                && let Ok(file) = arguments[0].parse()
            {
                self.open.remove(&file);
            }
            return;
        }
        let Some(result) = line.result else {
            if is_sync {
                self.syncing.insert(line.process.clone(), self.changes);
            }
            return;
        };
        let before = self.syncing.remove(&line.process).filter(|_| is_sync).unwrap_or(self.changes);
        if result < 0 {
            return;
        }
        let file = arguments[0].parse::<i64>().ok().and_then(|file| Some((file, *self.open.get(&file)?)));
        match (&*line.call, file) {
            ("openat", _) => {
                let Some(place) = self.place(arguments[0], arguments[1]) else { return };
                let node = match self.find(&place) {
                    Some(node) => node,
                    None => self.make(place, false),
                };
                if arguments[2].contains("O_TRUNC") {
                    self.nodes[node].length = 0;
                    self.change(node, Change::Cut(0));
                }
                let position = if arguments[2].contains("O_APPEND") { self.nodes[node].length } else { 0 };
                self.open.insert(result, (node, position));
            }
            ("lseek", Some((file, (node, _)))) => drop(self.open.insert(file, (node, result as u64))),
            ("write" | "writev", Some((file, (node, position)))) => {
                let bytes = line.bytes()[..result as usize].to_vec();
                self.open.insert(file, (node, position + result as u64));
                self.write(node, position, bytes);
            }
            ("pwrite64", Some((_, (node, _)))) => {
                let bytes = line.bytes()[..result as usize].to_vec();
                self.write(node, arguments[3].parse().unwrap(), bytes);
            }
            ("ftruncate", Some((_, (node, _)))) => {
                let length = arguments[1].parse().unwrap();
                self.nodes[node].length = length;
                self.change(node, Change::Cut(length));
            }
            ("fsync" | "fdatasync", Some((_, (node, _)))) => {
                if self.nodes[node].is_folder && !self.folders_sync {
                    return;
                }
                let pending = std::mem::take(&mut self.nodes[node].pending);
                for (number, change) in pending {
                    if number <= before {
                        self.nodes[node].apply(change);
                    } else {
                        self.nodes[node].pending.push((number, change));
                    }
                }
            }
            ("mkdir", _) => drop(self.place("", arguments[0]).map(|place| self.make(place, true))),
            ("mkdirat", _) => drop(self.place(arguments[0], arguments[1]).map(|place| self.make(place, true))),
            ("rename", _) => self.rename(self.place("", arguments[0]), self.place("", arguments[1])),
            ("renameat" | "renameat2", _) => {
                self.rename(self.place(arguments[0], arguments[1]), self.place(arguments[2], arguments[3]));
            }
            ("link", _) => self.link(self.place("", arguments[0]), self.place("", arguments[1])),
            ("linkat", _) => {
                self.link(self.place(arguments[0], arguments[1]), self.place(arguments[2], arguments[3]));
            }
            ("unlink" | "rmdir", _) => drop(self.place("", arguments[0]).map(|place| self.enter(place, None))),
            ("unlinkat", _) => drop(self.place(arguments[0], arguments[1]).map(|place| self.enter(place, None))),
            _ => {}
        }
    }

    fn link(&mut self, from: Option<(usize, String)>, to: Option<(usize, String)>) {
        let (Some(from), Some(to)) = (from, to) else { return };
        let node = self.find(&from);
        self.enter(to, node);
    }

    fn rename(&mut self, from: Option<(usize, String)>, to: Option<(usize, String)>) {
        self.link(from.clone(), to);
        if let Some(from) = from {
            self.enter(from, None);
        }
    }

    /// Writes down what is left after the power went. `keeps` says of each change that was not synced whether it survived.
    pub fn restore(mut self, target: &Path, keeps: &mut dyn FnMut() -> bool) {
        for node in 0..self.nodes.len() {
            for (_, change) in std::mem::take(&mut self.nodes[node].pending) {
                if keeps() {
                    self.nodes[node].apply(change);
                }
            }
        }
        self.restore_folder(0, target);
    }

    fn restore_folder(&self, folder: usize, target: &Path) {
        for (name, node) in &self.nodes[folder].entries {
            let (node, path) = (*node, target.join(name));
            if self.nodes[node].is_folder {
                std::fs::create_dir(&path).unwrap();
                self.restore_folder(node, &path);
            } else {
                std::fs::write(&path, &self.nodes[node].bytes).unwrap();
            }
        }
    }
}
