use crate::file_stamp::Stamp;
use std::fs;
use std::path::PathBuf;
use std::time::{Duration, SystemTime};

use super::*;

const STAGE: Namespace = Namespace { name: "test", version: 1, travels: true };

fn files(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().map(|e| e.unwrap().path());
    entries.flat_map(|p| if p.is_dir() { files(&p) } else { vec![p] }).collect()
}

fn filled() -> (tempfile::TempDir, Cache, Key) {
    let folder = tempfile::tempdir().unwrap();
    let cache = Cache::open(folder.path()).unwrap();
    let key = Key::new(&STAGE, &("input", 1.5f32));
    cache.put(&key, &vec![1u32, 2, 3]);
    assert_eq!(cache.flush(), Vec::<String>::new());
    (folder, cache, key)
}

#[test]
fn what_was_put_is_found_under_its_key_alone() {
    let (_folder, cache, key) = filled();
    assert_eq!(cache.get(&key), Some(vec![1u32, 2, 3]));
    for other in [
        Key::new(&STAGE, &("input", 1.6f32)),
        Key::new(&Namespace { version: 2, ..STAGE }, &("input", 1.5f32)),
        Key::new(&Namespace { name: "tes", version: 1, travels: true }, &("input", 1.5f32)),
    ] {
        assert_eq!(cache.get::<Vec<u32>>(&other), None);
    }
    assert_eq!(cache.take_uses()["test"], Uses { hits: 1, misses: 2 });
    assert_eq!(cache.flush(), Vec::<String>::new());
}

#[test]
fn every_damaged_byte_is_a_miss_with_a_warning_and_is_mended() {
    let (folder, cache, key) = filled();
    for map in ["actions", "blobs"] {
        let path = files(&folder.path().join(map)).pop().unwrap();
        let whole = fs::read(&path).unwrap();
        let mut damages: Vec<Vec<u8>> = vec![Vec::new(), whole[..whole.len() - 1].to_vec()];
        damages.push([&whole[..], &[0]].concat());
        damages.extend((0..whole.len()).map(|at| {
            let mut bytes = whole.clone();
            bytes[at] ^= 0x10;
            bytes
        }));
        for bytes in damages {
            fs::write(&path, bytes).unwrap();
            assert_eq!(cache.get::<Vec<u32>>(&key), None);
            assert_eq!(cache.flush().len(), 1);
            cache.put(&key, &vec![1u32, 2, 3]);
            assert_eq!(cache.flush(), Vec::<String>::new());
            assert_eq!(cache.get(&key), Some(vec![1u32, 2, 3]));
        }
    }
}

#[test]
fn another_type_of_value_is_a_miss() {
    let (_folder, cache, key) = filled();
    assert_eq!(cache.get::<Vec<String>>(&key), None);
    assert!(cache.flush()[0].contains("another version"));
}

#[test]
fn an_entry_moved_to_another_place_is_not_taken_for_what_belongs_there() {
    let (folder, cache, key) = filled();
    let other = Key::new(&Namespace { name: "other", version: 1, travels: true }, &0);
    let action = files(&folder.path().join("actions")).pop().unwrap();
    let to = cache.store.path(Map::Actions, other.digest());
    fs::create_dir_all(to.parent().unwrap()).unwrap();
    fs::copy(action, to).unwrap();
    assert_eq!(cache.get::<Vec<u32>>(&other), None);
    assert_eq!(cache.get(&key), Some(vec![1u32, 2, 3]));
}

#[test]
fn what_was_not_used_for_longest_goes_first() {
    let (folder, cache, old) = filled();
    for path in files(folder.path()) {
        let then = SystemTime::now() - Duration::from_secs(10 * 24 * 3600);
        fs::File::options().append(true).open(path).unwrap().set_modified(then).unwrap();
    }
    let new = Key::new(&STAGE, &2);
    cache.put(&new, &vec![9u8; 1000]);
    cache.flush();
    let all = cache.stats().unwrap();
    assert_eq!((all.entries, all.stages["test"].results), (4, 2));

    let removed = cache.collect(Some(all.bytes - 1), None).unwrap();
    assert_eq!((removed.files, removed.left.len()), (1, 0), "{removed:?}");
    assert!(cache.has(&new) && !cache.has(&old));
    cache.collect(None, Some(Duration::from_secs(24 * 3600))).unwrap();
    assert_eq!(cache.stats().unwrap().entries, 2);
    assert_eq!(cache.get(&new), Some(vec![9u8; 1000]));
    cache.clear().unwrap();
    assert_eq!(cache.stats().unwrap().entries, 0);
}

#[test]
fn a_use_is_noted_where_the_last_note_is_old_and_only_there() {
    let (folder, cache, key) = filled();
    let set_times = |age: u64| {
        let then = SystemTime::now() - Duration::from_secs(age);
        for path in files(folder.path()) {
            fs::File::options().append(true).open(path).unwrap().set_modified(then).unwrap();
        }
    };
    let ages = || {
        let entries = ["actions", "blobs"].map(|map| files(&folder.path().join(map)).pop().unwrap());
        entries.map(|path| fs::metadata(path).unwrap().modified().unwrap().elapsed().unwrap_or_default())
    };
    set_times(2 * 3600);
    assert_eq!(cache.get(&key), Some(vec![1u32, 2, 3]));
    assert!(ages().iter().all(|age| age.as_secs() < 60), "{:?}", ages());
    set_times(1800);
    assert_eq!(cache.get(&key), Some(vec![1u32, 2, 3]));
    assert!(ages().iter().all(|age| age.as_secs() >= 1800), "{:?}", ages());
}

#[test]
fn what_is_not_the_stores_own_stays() {
    let (folder, cache, key) = filled();
    let mine =
        ["tmp/mine", "blobs/aa/mine", "actions/mine/deep/file", "stamps/mine"].map(|p| folder.path().join(p));
    for path in &mine {
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, "mine").unwrap();
    }
    assert!(cache.verify().unwrap().is_sound());
    cache.collect(Some(0), Some(Duration::ZERO)).unwrap();
    cache.clear().unwrap();
    assert!(mine.iter().all(|path| path.exists()) && !cache.has(&key));
}

#[test]
fn lengths_that_nothing_has_are_a_miss() {
    for length in [1u64 << 40, u64::MAX / 2, u64::MAX] {
        assert_eq!(artefact::decode::<String>(&length.to_le_bytes()), None);
        assert_eq!(artefact::decode::<Vec<u64>>(&length.to_le_bytes()), None);
    }
}

#[test]
fn verify_finds_and_removes_what_is_damaged() {
    let (folder, cache, key) = filled();
    assert!(cache.verify().unwrap().is_sound());
    let blob = files(&folder.path().join("blobs")).pop().unwrap();
    let mut bytes = fs::read(&blob).unwrap();
    bytes[3] ^= 1;
    fs::write(&blob, bytes).unwrap();
    let verified = cache.verify().unwrap();
    assert!(verified.removed[0].path == blob && verified.left.is_empty(), "{verified:?}");
    assert!(cache.verify().unwrap().is_sound());
    assert_eq!(cache.get::<Vec<u32>>(&key), None);
}

/// As Windows says of a file that another program has open. Root may read what no permission allows, so it is a file that
/// gives an I/O error to everyone.
#[cfg(target_os = "linux")]
#[test]
fn an_entry_that_cannot_be_read_is_not_taken_for_damaged() {
    let (folder, cache, _) = filled();
    for map in ["actions", "blobs"] {
        let entry = files(&folder.path().join(map)).pop().unwrap();
        fs::remove_file(&entry).unwrap();
        std::os::unix::fs::symlink("/proc/self/mem", entry).unwrap();
    }
    let verified = cache.verify().unwrap();
    assert!(verified.removed.is_empty() && verified.left.len() == 2, "{verified:?}");
    assert!(verified.left.iter().all(|fault| fault.path.exists()), "they stay");
}

#[test]
fn digests_are_remembered_until_a_file_changes() {
    let (folder, cache, _) = filled();
    let path = folder.path().join("source");
    fs::write(&path, "frame").unwrap();
    let digest = blake3::hash(b"frame");
    assert!(!Stamp::of(&path).unwrap().is_settled(), "it may change again within the same tick");
    // Nothing sets back the time at which a file's times were set: the wait is what this is about.
    std::thread::sleep(Duration::from_millis(2100));
    let stamp = Stamp::of(&path).unwrap();
    assert!(stamp.is_settled());
    cache.remember(&path, &stamp, &digest);
    assert_eq!(cache.remembered(&path, &stamp), Some(digest));
    assert_eq!(cache.remembered(&folder.path().join("other"), &stamp), None);
    fs::write(&path, "frame").unwrap();
    assert_eq!(cache.remembered(&path, &Stamp::of(&path).unwrap()), None);
}

#[test]
fn a_store_that_cannot_be_written_is_a_warning() {
    let (folder, cache, _) = filled();
    fs::remove_dir_all(folder.path().join("tmp")).unwrap();
    cache.put(&Key::new(&STAGE, &3), &1u8);
    assert!(cache.flush()[0].contains("cannot be written"));
    assert_eq!(cache.get::<u8>(&Key::new(&STAGE, &3)), None);
}
