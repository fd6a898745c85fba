//! The remote by itself.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use volpack::cache::remote::{Map, Policy, Remote, Wanted};

use crate::server::{CEILING, Fault, SECRET, Server, USER, broken};

fn key(number: u32) -> [u8; 32] {
    let mut key = [0xa5; 32];
    key[..4].copy_from_slice(&number.to_le_bytes());
    key
}

fn entries(numbers: std::ops::Range<u32>) -> Vec<([u8; 32], Vec<u8>)> {
    numbers.map(|number| (key(number), format!("entry {number}").into_bytes())).collect()
}

fn keys(numbers: std::ops::Range<u32>) -> Vec<[u8; 32]> {
    numbers.map(key).collect()
}

fn get_many(remote: &Remote, map: Map, keys: &[[u8; 32]], limit: u64) -> Vec<Option<Vec<u8>>> {
    let wanted: Vec<Wanted> = keys.iter().map(|&digest| Wanted { digest, limit }).collect();
    remote.get_many(map, &wanted)
}

fn get(remote: &Remote, map: Map, key: [u8; 32]) -> Option<Vec<u8>> {
    get_many(remote, map, &[key], u64::MAX).remove(0)
}

/// That the remote was given up, says so with `reason`, asks the server nothing more and leaks no credentials.
fn assert_given_up(remote: &Remote, server: &Server, reason: &str) {
    let mut asked = server.requests();
    loop {
        // What was abandoned in flight may still arrive.
        std::thread::sleep(Duration::from_millis(200));
        match server.requests() {
            now if now == asked => break,
            now => asked = now,
        }
    }
    assert_eq!(get_many(remote, Map::Actions, &keys(0..50), 1000), vec![None; 50]);
    remote.put(Map::Actions, key(1000), vec![1]);
    let lines = remote.finish(CEILING, |_| true);
    assert_eq!(server.requests(), asked, "the server was asked after it was given up");
    assert_eq!(lines.len(), 2, "{lines:?}");
    let given_up = "the remote cache s3://bucket/some/prefix was given up after 3 failures in a row: ";
    assert!(lines[0].starts_with(given_up) && lines[0].contains(reason), "{lines:?}");
    assert!(lines[1].ends_with("not uploaded to the remote cache s3://bucket/some/prefix"), "{lines:?}");
    for line in lines {
        assert!(!line.contains(USER) && !line.contains(SECRET) && !line.contains('\n'), "{line}");
    }
}

#[test]
fn what_was_put_is_found_and_nothing_else() {
    let server = Server::start();
    let remote = server.filled(Map::Blobs, &entries(0..1));
    assert_eq!(get(&remote, Map::Blobs, key(0)), Some(b"entry 0".to_vec()));
    assert_eq!(get(&remote, Map::Actions, key(0)), None, "the maps are apart");
    assert_eq!(get(&remote, Map::Blobs, key(1)), None);
    // Misses are no failures, however many.
    assert_eq!(get_many(&remote, Map::Blobs, &keys(1..20), 1000), vec![None; 19]);
    assert_eq!(get(&remote, Map::Blobs, key(0)), Some(b"entry 0".to_vec()));
    assert_eq!(remote.finish(CEILING, |_| true), Vec::<String>::new());

    let hex = format!("00000000{}", "a5".repeat(28));
    let place: PathBuf = ["bucket/some/prefix/blobs", &hex[..2], &hex[2..]].iter().collect();
    assert_eq!(std::fs::read(server.folder().join(place)).unwrap(), b"entry 0");
}

#[test]
fn a_bucket_without_a_prefix_works_too() {
    let server = Server::start();
    let remote = server.remote_at("s3://bucket", Policy::ReadWrite);
    remote.put(Map::Actions, key(7), vec![7]);
    assert_eq!(remote.finish(CEILING, |_| true), Vec::<String>::new());
    assert_eq!(get(&remote, Map::Actions, key(7)), Some(vec![7]));
    assert!(server.folder().join("bucket/actions/07").is_dir());
}

#[test]
fn many_answers_come_in_the_order_of_the_keys() {
    let server = Server::start();
    let all = entries(0..200);
    let (there, _): (Vec<_>, Vec<_>) = all.iter().cloned().partition(|(key, _)| key[0] % 3 != 0);
    let remote = server.filled(Map::Actions, &there);
    let answers = get_many(&remote, Map::Actions, &keys(0..200), 1000);
    let expected: Vec<_> = all.into_iter().map(|(key, bytes)| (key[0] % 3 != 0).then_some(bytes)).collect();
    assert_eq!(answers, expected);
    assert_eq!(get_many(&remote, Map::Actions, &[], 1000), Vec::<Option<Vec<u8>>>::new());
}

#[test]
fn an_object_longer_than_the_limit_is_a_miss_and_is_not_read() {
    let server = Server::start();
    let length = 48 << 20;
    let remote = server.filled(Map::Blobs, &[(key(0), vec![3; length]), (key(1), vec![4; 100])]);
    assert_eq!(get_many(&remote, Map::Blobs, &keys(0..2), 100), [None, Some(vec![4; 100])]);
    assert_eq!(get_many(&remote, Map::Blobs, &keys(1..2), 99), [None]);
    // The buffers of a loopback connection hold a few MiB of what nobody reads.
    assert!(server.sent() < length as u64 / 2);
    assert_eq!(get(&remote, Map::Blobs, key(0)).map(|bytes| bytes.len()), Some(length));
    assert_eq!(remote.finish(CEILING, |_| true), Vec::<String>::new());
}

#[test]
fn blobs_are_written_once_and_actions_each_time() {
    let server = Server::start();
    server.filled(Map::Blobs, &[(key(0), vec![1; 10])]);
    server.filled(Map::Actions, &[(key(0), vec![1; 10])]);
    assert_eq!(server.writes(), 2);
    let remote = server.filled(Map::Blobs, &[(key(0), vec![2; 10])]);
    assert_eq!((server.writes(), get(&remote, Map::Blobs, key(0))), (2, Some(vec![1; 10])));
    let remote = server.filled(Map::Actions, &[(key(0), vec![2; 10])]);
    assert_eq!((server.writes(), get(&remote, Map::Actions, key(0))), (3, Some(vec![2; 10])));
    // One that was found to be damaged is replaced, though it is as long as it should be, and one of another length too.
    let remote = server.remote(Policy::ReadWrite);
    remote.distrust(key(0));
    remote.put(Map::Blobs, key(0), vec![1; 10]);
    assert_eq!(remote.finish(CEILING, |_| true), Vec::<String>::new());
    assert_eq!(server.writes(), 4);
    let remote = server.filled(Map::Blobs, &[(key(0), vec![3; 11])]);
    assert_eq!((server.writes(), get(&remote, Map::Blobs, key(0))), (5, Some(vec![3; 11])));
}

#[test]
fn racing_writers_leave_whole_objects() {
    let server = Server::start();
    let length = 200_000;
    let remotes = [(); 2].map(|()| server.remote(Policy::ReadWrite));
    std::thread::scope(|scope| {
        for (remote, byte) in remotes.iter().zip([1, 2]) {
            scope.spawn(move || {
                for _ in 0..3 {
                    keys(0..20).into_iter().for_each(|key| remote.put(Map::Actions, key, vec![byte; length]));
                }
            });
        }
        for _ in 0..10 {
            for bytes in get_many(&remotes[0], Map::Actions, &keys(0..20), u64::MAX).into_iter().flatten() {
                assert!(bytes.len() == length && bytes.iter().all(|byte| *byte == bytes[0]));
            }
        }
    });
    for remote in &remotes {
        assert_eq!(remote.finish(CEILING, |_| true), Vec::<String>::new());
    }
    for bytes in get_many(&remotes[0], Map::Actions, &keys(0..20), u64::MAX) {
        let bytes = bytes.unwrap();
        assert!(bytes.len() == length && bytes.iter().all(|byte| *byte == bytes[0]));
    }
}

#[test]
fn two_errors_are_retried() {
    let server = Server::start();
    let remote = server.filled(Map::Actions, &entries(0..1));
    let asked = server.requests();
    server.set(broken(2));
    assert_eq!(get(&remote, Map::Actions, key(0)), Some(b"entry 0".to_vec()));
    assert_eq!(server.requests(), asked + 3);
    server.set(broken(2));
    remote.put(Map::Actions, key(1), vec![1]);
    assert_eq!(remote.finish(CEILING, |_| true), Vec::<String>::new());
    assert_eq!(get(&remote, Map::Actions, key(1)), Some(vec![1]));
}

#[test]
fn an_answer_that_breaks_off_is_resumed() {
    let server = Server::start();
    let bytes: Vec<u8> = (0..300_000u32).flat_map(u32::to_le_bytes).collect();
    let remote = server.filled(Map::Blobs, &[(key(0), bytes.clone())]);
    server.set(Fault::Cut(1));
    assert!(get(&remote, Map::Blobs, key(0)) == Some(bytes));
    assert_eq!(remote.finish(CEILING, |_| true), Vec::<String>::new());
}

#[test]
fn failures_apart_are_told_but_give_nothing_up() {
    let server = Server::start();
    let remote = server.filled(Map::Actions, &entries(0..1));
    for _ in 0..4 {
        // Three attempts make one failure.
        server.set(broken(3));
        assert_eq!(get(&remote, Map::Actions, key(0)), None);
        assert_eq!(get(&remote, Map::Actions, key(0)), Some(b"entry 0".to_vec()));
    }
    let lines = remote.finish(CEILING, |_| true);
    assert_eq!(lines.len(), 1, "{lines:?}");
    let start = "4 requests to the remote cache s3://bucket/some/prefix failed, the last one: ";
    assert!(lines[0].starts_with(start), "{lines:?}");
}

#[test]
fn a_broken_server_is_given_up() {
    let server = Server::start();
    let remote = server.filled(Map::Actions, &entries(0..24));
    let asked = server.requests();
    server.set(broken(u32::MAX));
    let start = Instant::now();
    assert_eq!(get_many(&remote, Map::Actions, &keys(0..24), 1000), vec![None; 24]);
    assert!(start.elapsed() < CEILING);
    assert!(server.requests() - asked <= 24 * 3);
    assert_given_up(&remote, &server, "InternalError");
}

#[test]
fn a_silent_server_is_given_up() {
    let server = Server::start();
    let remote = server.filled(Map::Actions, &entries(0..1));
    server.set(Fault::Silent);
    let start = Instant::now();
    let (first, rest) = (keys(0..12), keys(12..24));
    std::thread::scope(|scope| {
        scope.spawn(|| assert_eq!(get_many(&remote, Map::Actions, &first, 1000), vec![None; 12]));
        scope.spawn(|| assert_eq!(get_many(&remote, Map::Blobs, &rest, 1000), vec![None; 12]));
    });
    assert!(start.elapsed() < CEILING);
    assert_given_up(&remote, &server, "no answer");
}

#[test]
fn a_silent_server_is_given_up_by_one_request_after_another() {
    let server = Server::start();
    let remote = server.filled(Map::Actions, &entries(0..1));
    let asked = server.requests();
    server.set(Fault::Silent);
    let start = Instant::now();
    for number in 0..24 {
        assert_eq!(get(&remote, Map::Actions, key(number)), None);
    }
    assert!(start.elapsed() < CEILING);
    assert_eq!(server.requests() - asked, 3);
    assert_given_up(&remote, &server, "no answer");
}

#[test]
fn a_dripping_server_is_given_up() {
    let server = Server::start();
    // At this rate they take longer than the ceiling.
    let slow: Vec<_> = keys(0..3).into_iter().map(|key| (key, vec![0; 400])).collect();
    let remote = server.filled(Map::Blobs, &slow);
    server.set(Fault::Drip);
    let start = Instant::now();
    assert_eq!(get_many(&remote, Map::Blobs, &keys(0..3), u64::MAX), vec![None; 3]);
    assert!(start.elapsed() < CEILING);
    assert_given_up(&remote, &server, "too slow");
}

#[test]
fn a_server_that_drops_connections_is_given_up() {
    let server = Server::start();
    let remote = server.filled(Map::Actions, &entries(0..1));
    server.set(Fault::Drop);
    assert_eq!(get_many(&remote, Map::Actions, &keys(0..24), 1000), vec![None; 24]);
    assert_given_up(&remote, &server, "");
}

#[test]
fn giving_up_abandons_what_is_in_flight() {
    let server = Server::start();
    let remote = server.remote(Policy::ReadWrite);
    server.set(Fault::Silent);
    // So large that its own deadline is beyond the ceiling.
    remote.put(Map::Actions, key(0), vec![0; 8 << 20]);
    while server.requests() == 0 {
        std::thread::sleep(Duration::from_millis(10));
    }
    server.set(broken(u32::MAX));
    assert_eq!(get_many(&remote, Map::Actions, &keys(1..4), 1000), vec![None; 3]);
    let start = Instant::now();
    assert_given_up(&remote, &server, "InternalError");
    assert!(start.elapsed() < CEILING);
}

#[test]
fn a_server_killed_between_writes_is_told() {
    let mut server = Server::start();
    let remote = server.filled(Map::Blobs, &entries(0..5));
    server.kill();
    for (key, bytes) in entries(5..25) {
        remote.put(Map::Blobs, key, bytes);
    }
    let start = Instant::now();
    let lines = remote.finish(CEILING, |_| true);
    assert!(start.elapsed() < CEILING);
    assert_eq!(lines.len(), 2, "{lines:?}");
    assert!(lines[0].contains("given up"), "{lines:?}");
    assert!(lines[1].starts_with("20 entries were not uploaded"), "{lines:?}");
}

#[test]
fn what_is_only_read_is_never_written() {
    let server = Server::start();
    server.filled(Map::Actions, &entries(0..1));
    let asked = server.requests();
    let remote = server.remote(Policy::Read);
    remote.put(Map::Actions, key(1), vec![1]);
    remote.put(Map::Blobs, key(1), vec![1]);
    assert_eq!(remote.finish(CEILING, |_| true), Vec::<String>::new());
    assert_eq!(server.requests(), asked);
    assert_eq!(get(&remote, Map::Actions, key(0)), Some(b"entry 0".to_vec()));
}

#[test]
fn what_does_not_fit_the_queue_is_dropped_and_told() {
    let server = Server::start();
    let remote = server.remote(Policy::ReadWrite);
    server.set(Fault::Hold);
    for number in 0..70 {
        remote.put(Map::Actions, key(number), vec![0; 1 << 20]);
    }
    server.set(Fault::Nothing);
    let lines = remote.finish(CEILING, |_| true);
    assert_eq!(lines, ["6 entries were not uploaded to the remote cache s3://bucket/some/prefix"]);
    assert_eq!(server.writes(), 64);
    // There is room again, even for an entry that is longer than the queue.
    remote.put(Map::Blobs, key(0), vec![0; 65 << 20]);
    assert_eq!(remote.finish(CEILING, |_| true), lines);
    assert_eq!(server.writes(), 65);
}

#[test]
fn the_end_waits_no_longer_than_it_may() {
    let server = Server::start();
    let remote = server.remote(Policy::ReadWrite);
    server.set(Fault::Silent);
    for (key, bytes) in entries(0..30) {
        remote.put(Map::Blobs, key, bytes);
    }
    let start = Instant::now();
    let lines = remote.finish(Duration::from_millis(50), |_| true);
    assert_eq!(lines, ["30 entries were not uploaded to the remote cache s3://bucket/some/prefix"]);
    drop(remote);
    // Less than the patience for one answer: nothing in flight was waited for.
    assert!(start.elapsed() < Duration::from_secs(3));
}

#[test]
fn credentials_that_may_only_read_stop_the_writes_alone() {
    let server = Server::start();
    let remote = server.filled(Map::Actions, &entries(0..1));
    server.set(Fault::ReadOnly);
    let writes = server.writes();
    entries(1..10).into_iter().for_each(|(key, bytes)| remote.put(Map::Blobs, key, bytes));
    let lines = remote.finish(CEILING, |_| true);
    assert!(lines.len() == 1 && lines[0].contains("may not be written"), "{lines:?}");
    assert!(lines[0].ends_with("403 Forbidden AccessDenied"), "{lines:?}");
    assert!(server.writes() > writes);
    let writes = server.writes();
    remote.put(Map::Actions, key(1), vec![1]);
    assert_eq!(remote.finish(CEILING, |_| true), Vec::<String>::new());
    assert_eq!(server.writes(), writes);
    assert_eq!(get(&remote, Map::Actions, key(0)), Some(b"entry 0".to_vec()));
}

#[test]
fn mistakes_in_the_url_or_the_credentials_are_failures() {
    for (status, code) in [(404, "NoSuchBucket"), (403, "InvalidAccessKeyId")] {
        let server = Server::start();
        let remote = server.remote(Policy::ReadWrite);
        server.set(Fault::Refuse(u32::MAX, status, code));
        assert_eq!(get_many(&remote, Map::Actions, &keys(0..5), 1000), vec![None; 5]);
        assert_given_up(&remote, &server, code);
    }
}

#[test]
fn urls_and_options_without_sense_are_refused() {
    for url in ["", "bucket", "s3:///prefix", "file:///tmp/cache", "memory:///", "https://example.com/cache"]
    {
        assert!(Remote::open(url, Policy::Read).is_err(), "{url}");
    }
    for option in [("aws_nonsense", "1"), ("aws_allow_http", "perhaps")] {
        let opened = Remote::open_with("s3://bucket", Policy::Read, &[option]);
        assert!(opened.is_err(), "{option:?}");
    }
    assert!(Remote::open("gs://bucket/prefix", Policy::Read).is_ok());
    let account = [("azure_storage_account_name", "account")];
    assert!(Remote::open_with("az://container/prefix", Policy::Read, &account).is_ok());
}
