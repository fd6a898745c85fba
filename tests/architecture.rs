//! The house that the sources are: which room may know which.
//!
//! Every path of the crate's own in `src` and in `crates/*/src` is an import, be it in a `use` or in code. It counts as one
//! of the file that defines the name, wherever the name is exported again.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::fs;
use std::path::{Path, PathBuf};

/// The rooms from the ground up. Each may know those before it, and none after it. A room is a module with all that is in
/// it, but for what is a room of its own; the crate `volpack_x` is the room `x`.
const ROOMS: [&str; 38] = [
    "format",
    "units",
    "cancel",
    "progress",
    "pods",
    "file_name",
    "file_stamp",
    "volume",
    "codec",
    "vdb",
    "settings",
    "component",
    "atomic_file",
    "profile",
    "pack",
    "error",
    "cache",
    "digest",
    "sequence",
    "manifest",
    "render",
    // Below the stages: what compares a pack with its source must not use what made the pack.
    "verify",
    "stages::metadata",
    "stages::select",
    "stages::flatten",
    "stages::dedup",
    "stages::encoder_cache",
    "stages::allocate",
    "stages::relayout",
    "stages::quantise",
    "stages::serialise",
    "stages",
    "report",
    "pipeline",
    "sweep",
    "cli",
    "lib",
    "main",
];

/// What a room must not know although it lies below, or is a crate from elsewhere.
const STRANGERS: [(&str, &str); 4] = [
    // What is kept of a stage is the pipeline's to say.
    ("stages", "cache"),
    ("stages", "render"),
    ("stages", "verify"),
    // Words of the command line.
    ("stages", "clap"),
];

/// Imports that should not be and still are: whose, and of what. Somebody is at work on each. One that is no longer needed
/// has to go.
const NOT_YET: &[(&str, &str)] = &[];

#[test]
fn every_import_goes_down() {
    let house = House::read(Path::new(env!("CARGO_MANIFEST_DIR")));
    let found = house.findings(NOT_YET);
    let mut wrong = found.clone();
    for (i, (from, to)) in NOT_YET.iter().enumerate() {
        let others: Vec<_> = NOT_YET.iter().enumerate().filter(|(k, _)| *k != i).map(|(_, e)| *e).collect();
        if house.findings(&others) == found {
            wrong.push(format!(
                "NOT_YET excuses what `{from}` knows of `{to}`, and nothing needs that: take the entry out"
            ));
        }
    }
    assert!(wrong.is_empty(), "{} finding(s):\n{}", wrong.len(), wrong.join("\n"));
}

#[test]
fn imports_are_read_as_rust_reads_them() {
    let folder = tempfile::tempdir().unwrap();
    let write = |path: &str, text: &str| {
        let path = folder.path().join(path);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    };
    write("src/lib.rs", "mod vdb; mod pack; mod cli;");
    write("src/vdb/mod.rs", "mod tree; mod value;\npub use tree::{Tree, Leaf as Brick};\npub use value::*;");
    write("src/vdb/tree.rs", "pub struct Tree; pub struct Leaf;\nuse super::Scalar;");
    write(
        "src/vdb/value.rs",
        "// use crate::cli::no;\npub trait Scalar {}\n#[macro_export] macro_rules! each { () => {} }",
    );
    write(
        "src/pack.rs",
        "use crate::vdb::{self, Brick};\nfn f<'a>(_: &'a str) -> char { let _ = \"crate::cli\"; vdb::Tree; '\\'' }",
    );
    write("src/cli/mod.rs", "mod args; use crate::each; mod tests { use super::super::pack; }");
    write("src/cli/args.rs", "fn f() { crate::pack::open(/* crate::vdb /* */ */); ::clap::x(); }");
    write("crates/cache/src/lib.rs", "pub mod store;");
    write("crates/cache/src/store.rs", "use clap::Parser;");
    write("crates/cache/Cargo.toml", "[package]\nname = \"volpack-cache\"");
    write("src/main.rs", "use volpack::cli;\nuse volpack_cache::store::{Store};");
    let house = House::read(folder.path());
    let imports: Vec<String> = house
        .imports
        .iter()
        .map(|i| {
            format!("{} {}", house.files[i.from].path, i.to.map_or(&*i.text, |to| &house.files[to].path))
        })
        .filter(|import| !import.ends_with(" std"))
        .collect::<BTreeSet<_>>()
        .into_iter()
        .collect();
    assert_eq!(
        imports,
        [
            "crates/cache/src/store.rs clap",
            "src/cli/args.rs clap",
            "src/cli/args.rs src/pack.rs",
            "src/cli/mod.rs src/pack.rs",
            "src/cli/mod.rs src/vdb/value.rs",
            "src/main.rs crates/cache/src/store.rs",
            "src/main.rs src/cli/mod.rs",
            "src/pack.rs src/vdb/mod.rs",
            "src/pack.rs src/vdb/tree.rs",
            "src/vdb/mod.rs src/vdb/tree.rs",
            "src/vdb/mod.rs src/vdb/value.rs",
            "src/vdb/tree.rs src/vdb/value.rs",
        ]
    );
    assert_eq!(house.files[0].room, Some("cache"));
    assert!(house.circles(&[]).is_empty());
}

/// A module's path, its crate first.
type ModulePath = Vec<String>;

struct SourceFile {
    /// Below the root of the repository.
    path: String,
    module: ModulePath,
    /// The module's path without its crate.
    name: String,
    room: Option<&'static str>,
}

/// A module: a file, or a part of one.
#[derive(Default)]
struct Module {
    file: usize,
    /// The names that it defines.
    defines: BTreeSet<String>,
    /// The names that it takes from elsewhere, and from where.
    uses: Vec<(String, ModulePath)>,
    /// Where it takes every name from.
    globs: Vec<ModulePath>,
}

/// A path in a file, as it stands there.
struct Mention {
    module: ModulePath,
    path: Vec<String>,
    line: usize,
}

struct Import {
    from: usize,
    line: usize,
    /// As it is written.
    text: String,
    /// The file that defines the name; none for other people's crates.
    to: Option<usize>,
    /// What of that file, where that is not the file as a whole.
    item: Option<String>,
}

#[derive(Default)]
struct House {
    files: Vec<SourceFile>,
    modules: BTreeMap<ModulePath, Module>,
    imports: Vec<Import>,
}

/// Re-exports of re-exports that are followed.
const MOST_STEPS: usize = 16;

impl House {
    fn read(root: &Path) -> Self {
        let mut house = Self::default();
        let mut mentions = Vec::new();
        let mut crates = vec![("volpack".to_owned(), root.join("src"))];
        for folder in entries(&root.join("crates")) {
            let manifest = fs::read_to_string(folder.join("Cargo.toml")).unwrap_or_default();
            let name =
                manifest.lines().find_map(|line| line.trim().strip_prefix("name = \"")?.strip_suffix('"'));
            crates.extend(name.map(|name| (name.replace('-', "_"), folder.join("src"))));
        }
        crates.sort_by(|a, b| a.1.cmp(&b.1));
        for (name, folder) in &crates {
            for path in sources(folder) {
                let mut module = vec![name.clone()];
                let inside = path.strip_prefix(folder).unwrap().with_extension("");
                module.extend(inside.iter().map(|part| part.to_string_lossy().into_owned()));
                if module.last().is_some_and(|last| last == "mod" || last == "lib" && module.len() == 2) {
                    module.pop();
                } else if module[1..] == ["main"] {
                    // A crate of its own, which knows the library by its name.
                    module = vec![format!("{name} main")];
                }
                let text = fs::read_to_string(&path).unwrap();
                let file = house.files.len();
                let path = path.strip_prefix(root).unwrap().to_string_lossy().replace('\\', "/");
                let name = name_of(&module);
                let room = room(&name);
                house.files.push(SourceFile { path, module: module.clone(), name, room });
                Reader { house: &mut house, mentions: &mut mentions, file, tokens: tokens(&text), at: 0 }
                    .module(module);
            }
        }
        house.find_imports(&mentions);
        house
    }

    fn is_crate(&self, name: &str) -> bool {
        self.modules.contains_key(&[name.to_owned()][..])
    }

    /// A path from its crate on, where it is one of ours.
    fn absolute(&self, module: &[String], path: &[String]) -> Option<ModulePath> {
        let mut start = module.to_vec();
        let mut rest = path;
        match &*path[0] {
            "crate" => start.truncate(1),
            "self" => {}
            "super" => {
                while rest.first().is_some_and(|part| part == "super") {
                    start.pop();
                    rest = &rest[1..];
                }
                return Some([&start, rest].concat());
            }
            first => {
                let child = [module, &path[..1]].concat();
                let knows = |m: &Module| m.uses.iter().any(|(name, _)| name == first);
                if self.modules.contains_key(&child) || self.modules.get(module).is_some_and(knows) {
                    return Some([module, path].concat());
                }
                return self.is_crate(first).then(|| path.to_vec());
            }
        }
        rest = &rest[1..];
        Some([&start, rest].concat())
    }

    /// The files that define what an absolute path names, and what it is in them.
    fn resolve(&self, path: &[String], steps: usize) -> Vec<(usize, Option<String>)> {
        let mut depth = 1;
        while depth < path.len() && self.modules.contains_key(&path[..=depth]) {
            depth += 1;
        }
        let (at, rest) = path.split_at(depth);
        let Some(module) = self.modules.get(at) else { return Vec::new() };
        let Some(name) = rest.first().filter(|_| steps < MOST_STEPS) else {
            return vec![(module.file, None)];
        };
        let here = (module.file, Some(name.clone()));
        if module.defines.contains(name) {
            return vec![here];
        }
        let mut found = Vec::new();
        for (_, target) in module.uses.iter().filter(|(used, _)| used == name) {
            // A name that stands for itself, as in `use value::value`.
            match self.absolute(at, target).filter(|target| target[..] != path[..=depth]) {
                Some(target) => found.extend(self.resolve(&[&target, &rest[1..]].concat(), steps + 1)),
                None => return Vec::new(),
            }
        }
        if found.is_empty() {
            let targets = module.globs.iter().filter_map(|glob| self.absolute(at, glob));
            let defines = |target: &ModulePath| {
                let knows =
                    |m: &Module| m.defines.contains(name) || m.uses.iter().any(|(used, _)| used == name);
                self.modules.get(target).is_some_and(knows)
            };
            for target in targets.filter(defines) {
                found.extend(self.resolve(&[&target, rest].concat(), steps + 1));
            }
        }
        if found.is_empty() { vec![here] } else { found }
    }

    fn find_imports(&mut self, mentions: &[Mention]) {
        let mut imports = Vec::new();
        for Mention { module, path, line } in mentions {
            let from = self.modules[module].file;
            let text = path.join("::");
            match self.absolute(module, path) {
                Some(path) => {
                    let found = self.resolve(&path, 0).into_iter().filter(|(to, _)| *to != from);
                    imports.extend(found.map(|(to, item)| {
                        let text = text.clone();
                        Import { from, line: *line, text, to: Some(to), item }
                    }));
                }
                None => {
                    imports.push(Import { from, line: *line, text: path[0].clone(), to: None, item: None })
                }
            }
        }
        self.imports = imports;
    }

    fn is_excused(&self, import: &Import, excused: &[(&str, &str)]) -> bool {
        let from = &self.files[import.from].name;
        let to = import.to.map_or(&import.text, |to| &self.files[to].name);
        excused.iter().any(|(a, b)| is_in(from, a) && is_in(to, b))
    }

    /// What is wrong, in words.
    fn findings(&self, excused: &[(&str, &str)]) -> Vec<String> {
        let mut out: Vec<String> = Vec::new();
        for file in &self.files {
            if file.room.is_none() {
                out.push(format!(
                    "{}: in no room: say in ROOMS of tests/architecture.rs how high it lies",
                    file.path
                ));
            }
        }
        let imports = self.imports.iter().filter(|import| !self.is_excused(import, excused));
        out.extend(imports.filter_map(|import| self.rule_broken_by(import)));
        out.dedup();
        out.extend(self.circles(excused));
        out
    }

    fn rule_broken_by(&self, import: &Import) -> Option<String> {
        let from = self.files[import.from].room?;
        let at = format!("{}:{}: imports {}", self.files[import.from].path, import.line, import.text);
        let to = match import.to {
            Some(to) => self.files[to].room?,
            None => &import.text,
        };
        if STRANGERS.iter().any(|(a, b)| is_in(from, a) && is_in(to, b)) {
            return Some(format!("{at}: `{from}` must know nothing of `{to}`"));
        }
        let height = |room: &str| ROOMS.iter().position(|other| *other == room);
        let goes_up = import.to.is_some() && height(from) < height(to);
        if goes_up {
            let defined = import.to.map_or("", |to| &self.files[to].path);
            return Some(format!(
                "{at} of {defined}: `{from}` lies below `{to}`, and must not know what is above it"
            ));
        }
        // The pipeline strings the stages together.
        let runs =
            from != to && is_in(from, "stages") && to.strip_prefix("stages::") == import.item.as_deref();
        (runs && import.item.is_some())
            .then(|| format!("{at}: a stage must not run another, which is the pipeline's to do"))
    }

    /// Files that know each other. What a module knows of those inside it does not count: it is they that make it up, and
    /// they know what stands in it.
    fn circles(&self, excused: &[(&str, &str)]) -> Vec<String> {
        let mut imports: BTreeMap<[usize; 2], &Import> = BTreeMap::new();
        for import in self.imports.iter().filter(|import| !self.is_excused(import, excused)) {
            let Some(to) = import.to else { continue };
            if !self.files[to].module.starts_with(&self.files[import.from].module) {
                imports.entry([import.from, to]).or_insert(import);
            }
        }
        let mut edges = vec![Vec::new(); self.files.len()];
        imports.keys().for_each(|[from, to]| edges[*from].push(*to));
        let reached: Vec<BTreeSet<usize>> = (0..self.files.len()).map(|file| reached(&edges, file)).collect();
        let mut circles = BTreeSet::new();
        for (file, others) in reached.iter().enumerate().filter(|(file, others)| others.contains(file)) {
            circles.insert(
                others.iter().copied().filter(|other| reached[*other].contains(&file)).collect::<Vec<_>>(),
            );
        }
        let told = circles.iter().map(|circle| {
            let mut out = format!("{} files import each other in a circle, which none may:", circle.len());
            for ([from, to], import) in &imports {
                if circle.contains(from) && circle.contains(to) {
                    let [from, to] = [from, to].map(|file| &self.files[*file].path);
                    write!(out, "\n    {from}:{}: imports {} of {to}", import.line, import.text).unwrap();
                }
            }
            out
        });
        told.collect()
    }
}

/// A module's path without its crate.
fn name_of(module: &[String]) -> String {
    let inside = module[1..].join("::");
    match module[0].strip_prefix("volpack_") {
        Some(room) if inside.is_empty() => room.to_owned(),
        Some(room) => format!("{room}::{inside}"),
        None if module[0].ends_with(" main") => "main".to_owned(),
        None if inside.is_empty() => "lib".to_owned(),
        None => inside,
    }
}

/// The room that a module of this name is in.
fn room(name: &str) -> Option<&'static str> {
    ROOMS.into_iter().filter(|room| is_in(name, room)).max_by_key(|room| room.len())
}

/// Whether a module is another one or inside it.
fn is_in(name: &str, room: &str) -> bool {
    name.strip_prefix(room).is_some_and(|rest| rest.is_empty() || rest.starts_with("::"))
}

/// What can be reached in one step or more.
fn reached(edges: &[Vec<usize>], from: usize) -> BTreeSet<usize> {
    let mut out = BTreeSet::new();
    let mut open = edges[from].clone();
    while let Some(file) = open.pop() {
        if out.insert(file) {
            open.extend(&edges[file]);
        }
    }
    out
}

fn entries(folder: &Path) -> Vec<PathBuf> {
    let Ok(entries) = fs::read_dir(folder) else { return Vec::new() };
    let mut entries: Vec<PathBuf> = entries.map(|entry| entry.unwrap().path()).collect();
    entries.sort();
    entries
}

/// The Rust files of a folder and of those in it.
fn sources(folder: &Path) -> Vec<PathBuf> {
    let of_entry = |path: PathBuf| match path.extension() {
        Some(extension) if extension == "rs" => vec![path],
        _ if path.is_dir() => sources(&path),
        _ => Vec::new(),
    };
    entries(folder).into_iter().flat_map(of_entry).collect()
}

/// As much of Rust's grammar as paths need.
struct Reader<'a> {
    house: &'a mut House,
    mentions: &'a mut Vec<Mention>,
    file: usize,
    tokens: Vec<Token>,
    at: usize,
}

impl Reader<'_> {
    fn text(&self, ahead: usize) -> &str {
        self.tokens.get(self.at + ahead).map_or("", |token| &token.text)
    }

    fn take_if(&mut self, text: &str) -> bool {
        let is = self.text(0) == text;
        self.at += usize::from(is);
        is
    }

    /// Reads a module to the brace that ends it, or to the end of the file.
    fn module(&mut self, path: ModulePath) {
        let file = self.file;
        self.house.modules.insert(path.clone(), Module { file, ..Module::default() });
        let mut depth = 0;
        while let Some(token) = self.tokens.get(self.at).cloned() {
            self.at += 1;
            match &*token.text {
                "{" => depth += 1,
                "}" if depth == 0 => return,
                "}" => depth -= 1,
                "use" if self.text(0) != "<" => self.use_tree(&path, &[]),
                "mod" if self.text(1) == "{" => {
                    let name = self.text(0).to_owned();
                    self.at += 2;
                    self.module([&path[..], &[name]].concat());
                }
                "macro_rules" => {
                    let name = self.text(1).to_owned();
                    // Exported ones are the crate's, wherever they stand.
                    let defined = [&path[..], std::slice::from_ref(&name)].concat();
                    self.here(&path).defines.insert(name.clone());
                    let root = self.house.modules.entry(path[..1].to_vec()).or_default();
                    let way = [&["crate".to_owned()], &defined[1..]].concat();
                    if path.len() > 1 {
                        root.uses.push((name, way));
                    }
                }
                "struct" | "enum" | "union" | "trait" | "type" | "fn" | "const" | "static" if depth == 0 => {
                    let skipped = usize::from(self.text(0) == "mut");
                    let name = self.text(skipped).to_owned();
                    self.here(&path).defines.insert(name);
                }
                _ if token.is_name() && self.text(0) == "::" => {
                    let mut parts = vec![token.text.clone()];
                    while self.text(0) == "::" && self.tokens.get(self.at + 1).is_some_and(Token::is_name) {
                        parts.push(self.text(1).to_owned());
                        self.at += 2;
                    }
                    self.mention(&path, parts, token.line);
                }
                _ => {}
            }
        }
    }

    fn here(&mut self, path: &[String]) -> &mut Module {
        self.house.modules.get_mut(path).expect("it was inserted when it began")
    }

    fn mention(&mut self, module: &[String], path: Vec<String>, line: usize) {
        self.mentions.push(Mention { module: module.to_vec(), path, line });
    }

    /// Reads what follows `use` or a brace in it.
    fn use_tree(&mut self, module: &[String], before: &[String]) {
        let mut path = before.to_vec();
        let line = self.tokens.get(self.at).map_or(0, |token| token.line);
        loop {
            let token = self.text(0).to_owned();
            self.at += 1;
            match &*token {
                "::" | "$" => {}
                "{" => {
                    while !self.take_if("}") && self.at < self.tokens.len() {
                        self.use_tree(module, &path);
                        self.take_if(",");
                    }
                    return;
                }
                "*" => {
                    self.here(module).globs.push(path.clone());
                    return self.mention(module, path, line);
                }
                _ => {
                    path.push(token);
                    if self.text(0) != "::" {
                        break;
                    }
                }
            }
        }
        if path.len() > 1 && path.last().is_some_and(|last| last == "self") {
            path.pop();
        }
        let last = path.last().cloned().unwrap_or_default();
        let name = if self.take_if("as") {
            self.at += 1;
            self.tokens[self.at - 1].text.clone()
        } else {
            last
        };
        self.here(module).uses.push((name, path.clone()));
        self.mention(module, path, line);
    }
}

#[derive(Clone)]
struct Token {
    text: String,
    line: usize,
}

impl Token {
    fn is_name(&self) -> bool {
        self.text.starts_with(|c: char| c.is_alphabetic() || c == '_')
    }
}

/// A file's names and signs: no comments, nor what stands in quotes.
fn tokens(source: &str) -> Vec<Token> {
    let chars: Vec<char> = source.chars().collect();
    let at = |i: usize| chars.get(i).copied().unwrap_or('\0');
    let is_word = |c: char| c.is_alphanumeric() || c == '_';
    let (mut out, mut i, mut line) = (Vec::new(), 0, 1);
    while i < chars.len() {
        let start = i;
        match at(i) {
            '/' if at(i + 1) == '/' => {
                while i < chars.len() && at(i) != '\n' {
                    i += 1;
                }
            }
            '/' if at(i + 1) == '*' => {
                let mut depth = 0;
                loop {
                    let step = match [at(i), at(i + 1)] {
                        ['/', '*'] => 1,
                        ['*', '/'] => -1,
                        _ => 0,
                    };
                    depth += step;
                    i += if step == 0 { 1 } else { 2 };
                    if depth == 0 || i >= chars.len() {
                        break;
                    }
                }
            }
            '"' => i = end_of_text(&chars, i),
            // A lifetime has no second quote; a character has one, with a backslash or without.
            '\'' if at(i + 1) == '\\' => {
                i += 3;
                while i < chars.len() && at(i) != '\'' {
                    i += 1;
                }
                i += 1;
            }
            '\'' => i += if at(i + 2) == '\'' { 3 } else { 1 },
            c if is_word(c) => {
                while is_word(at(i)) {
                    i += 1;
                }
                let word: String = chars[start..i].iter().collect();
                let hashes = (0..).take_while(|n| at(i + n) == '#').count();
                let is_raw = matches!(&*word, "r" | "br" | "cr") && at(i + hashes) == '"';
                if is_raw {
                    let end: Vec<char> =
                        std::iter::once('"').chain(std::iter::repeat_n('#', hashes)).collect();
                    i += hashes + 1;
                    while i < chars.len() && !chars[i..].starts_with(&end) {
                        i += 1;
                    }
                    i += end.len();
                } else if word == "r" && hashes == 1 {
                    // A raw name: what follows is the name.
                    i += 1;
                } else {
                    out.push(Token { text: word, line });
                }
            }
            ':' if at(i + 1) == ':' => {
                i += 2;
                out.push(Token { text: "::".to_owned(), line });
            }
            c => {
                i += 1;
                if !c.is_whitespace() {
                    out.push(Token { text: c.to_string(), line });
                }
            }
        }
        line += chars[start..i.min(chars.len())].iter().filter(|c| **c == '\n').count();
    }
    out
}

/// The place behind the text in quotes that begins here.
fn end_of_text(chars: &[char], mut i: usize) -> usize {
    i += 1;
    while i < chars.len() && chars[i] != '"' {
        i += if chars[i] == '\\' { 2 } else { 1 };
    }
    i + 1
}
