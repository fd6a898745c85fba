//! A real S3 server on loopback, behind faults that the tests switch on.

use std::io;
use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering::SeqCst};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures_util::{StreamExt, TryStreamExt, stream};
use http_body_util::{BodyExt, StreamBody};
use hyper::body::{Bytes, Frame, Incoming};
use hyper::service::service_fn;
use hyper::{Method, Request, Response};
use hyper_util::rt::{TokioExecutor, TokioIo};
use hyper_util::server::conn::auto;
use s3s::auth::SimpleAuth;
use s3s::service::{S3Service, S3ServiceBuilder};
use s3s_fs::FileSystem;
use tokio::net::TcpListener;
use tokio::runtime::Runtime;
use volpack::cache::remote::{Map, Policy, Remote};

/// Long enough for everything that is not meant to hang, on a busy machine.
pub const CEILING: Duration = Duration::from_secs(30);
pub const SECRET: &str = "the-secret-key";
pub const USER: &str = "the-user-key";

/// What the server does instead of answering.
#[derive(Clone, Copy, Debug)]
pub enum Fault {
    Nothing,
    /// Refuses so many more requests with a status and a code, quoting credentials as some servers do.
    Refuse(u32, u16, &'static str),
    /// Accepts and answers only after the ceiling, so that a test fails rather than hangs.
    Silent,
    /// Closes the connection instead of answering.
    Drop,
    /// Closes the connection in the middle of so many more answers.
    Cut(u32),
    /// Sends the head of an answer and then one byte every 100 ms.
    Drip,
    /// Waits until the fault is another one.
    Hold,
    /// Refuses to be written.
    ReadOnly,
}

pub fn broken(requests: u32) -> Fault {
    Fault::Refuse(requests, 500, "InternalError")
}

/// What the fault layer sees.
pub struct Gate {
    fault: Mutex<Fault>,
    /// Requests that pass before there is a fault.
    before: AtomicU64,
    requests: AtomicU64,
    writes: AtomicU64,
    /// Bytes of answers.
    sent: AtomicU64,
    /// Held by a request until its answer is sent, on Windows.
    turn: Arc<tokio::sync::Mutex<()>>,
}

impl Gate {
    /// The fault that the next request meets.
    fn next(&self) -> Fault {
        let passes = |left: u64| left.checked_sub(1);
        if self.before.fetch_update(SeqCst, SeqCst, passes).is_ok() {
            return Fault::Nothing;
        }
        let mut fault = self.fault.lock().unwrap();
        let met = *fault;
        match &mut *fault {
            Fault::Refuse(left, ..) | Fault::Cut(left) if *left > 1 => *left -= 1,
            Fault::Refuse(..) | Fault::Cut(_) => *fault = Fault::Nothing,
            _ => {}
        }
        met
    }

    async fn answer(
        self: Arc<Self>,
        s3: S3Service,
        request: Request<Incoming>,
    ) -> Result<Response<s3s::Body>, io::Error> {
        let is_write = request.method() == Method::PUT;
        self.requests.fetch_add(1, SeqCst);
        self.writes.fetch_add(u64::from(is_write), SeqCst);
        let fault = match self.next() {
            Fault::ReadOnly if is_write => Fault::Refuse(1, 403, "AccessDenied"),
            fault => fault,
        };
        match fault {
            Fault::Refuse(_, status, code) => {
                let body = format!("no, {USER}! <Error><Code>{code}</Code><Key>{SECRET}</Key></Error>");
                return Ok(Response::builder().status(status).body(body.into()).unwrap());
            }
            Fault::Silent => {
                tokio::time::sleep(CEILING * 2).await;
                return Err(io::ErrorKind::TimedOut.into());
            }
            Fault::Drop => return Err(io::ErrorKind::ConnectionReset.into()),
            Fault::Hold => {
                while matches!(*self.fault.lock().unwrap(), Fault::Hold) {
                    tokio::time::sleep(Duration::from_millis(10)).await;
                }
            }
            _ => {}
        }
        // s3s-fs replaces an object's file while other requests read it, which wine refuses.
        let turn = if cfg!(windows) { Some(self.turn.clone().lock_owned().await) } else { None };
        let (head, body) = s3
            .call(request.map(s3s::Body::from))
            .await
            .map_err(|error| io::Error::other(format!("{error:?}")))?
            .into_parts();
        let body = match fault {
            Fault::Cut(_) => {
                let bytes = BodyExt::collect(body).await.unwrap().to_bytes();
                let half = bytes.slice(..bytes.len() / 2);
                let cut = Err(io::ErrorKind::ConnectionReset.into());
                // The pause lets the half arrive.
                let cut = stream::once(async {
                    tokio::time::sleep(Duration::from_millis(50)).await;
                    cut
                });
                stream::iter([Ok(half)]).chain(cut).boxed()
            }
            Fault::Drip => {
                let bytes = BodyExt::collect(body).await.unwrap().to_bytes();
                let drops = (0..bytes.len()).map(move |at| bytes.slice(at..at + 1));
                let drops = stream::iter(drops).then(|drop| async {
                    tokio::time::sleep(Duration::from_millis(100)).await;
                    Ok(drop)
                });
                drops.boxed()
            }
            _ => TryStreamExt::map_err(body, io::Error::other).boxed(),
        };
        let counted = body.inspect_ok(move |bytes: &Bytes| {
            let _held = &turn;
            self.sent.fetch_add(bytes.len() as u64, SeqCst);
        });
        let body = s3s::Body::http_body_unsync(StreamBody::new(counted.map_ok(Frame::data)));
        Ok(Response::from_parts(head, body))
    }
}

/// An S3 server with the bucket `bucket`, in a folder that goes with it.
pub struct Server {
    runtime: Option<Runtime>,
    gate: Arc<Gate>,
    endpoint: String,
    folder: tempfile::TempDir,
}

impl Server {
    pub fn start() -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("bucket")).unwrap();
        let mut s3 = S3ServiceBuilder::new(FileSystem::new(folder.path()).unwrap());
        s3.set_auth(SimpleAuth::from_single(USER, SECRET));
        let s3 = s3.build();
        let gate = Arc::new(Gate {
            fault: Mutex::new(Fault::Nothing),
            before: AtomicU64::new(0),
            requests: AtomicU64::new(0),
            writes: AtomicU64::new(0),
            sent: AtomicU64::new(0),
            turn: Arc::default(),
        });
        let runtime = Runtime::new().unwrap();
        let listener = runtime.block_on(TcpListener::bind("127.0.0.1:0")).unwrap();
        let endpoint = format!("http://{}", listener.local_addr().unwrap());
        let door = gate.clone();
        runtime.spawn(async move {
            loop {
                let (socket, _) = listener.accept().await.unwrap();
                let (door, s3) = (door.clone(), s3.clone());
                let service = service_fn(move |request| door.clone().answer(s3.clone(), request));
                tokio::spawn(async move {
                    let http = auto::Builder::new(TokioExecutor::new());
                    let _ = http.serve_connection(TokioIo::new(socket), service).await;
                });
            }
        });
        Self { runtime: Some(runtime), gate, endpoint, folder }
    }

    pub fn set(&self, fault: Fault) {
        *self.gate.fault.lock().unwrap() = fault;
    }

    /// Faults that begin after so many requests more.
    pub fn set_after(&self, requests: u64, fault: Fault) {
        self.gate.before.store(requests, SeqCst);
        self.set(fault);
    }

    pub fn requests(&self) -> u64 {
        self.gate.requests.load(SeqCst)
    }

    /// Bytes of answers.
    pub fn sent(&self) -> u64 {
        self.gate.sent.load(SeqCst)
    }

    pub fn writes(&self) -> u64 {
        self.gate.writes.load(SeqCst)
    }

    pub fn remote(&self, policy: Policy) -> Remote {
        self.remote_at("s3://bucket/some/prefix", policy)
    }

    pub fn remote_at(&self, url: &str, policy: Policy) -> Remote {
        Remote::open_with(url, policy, &self.options()).unwrap()
    }

    /// What a client has to know; in upper case, what it finds in the environment.
    pub fn options(&self) -> [(&str, &str); 5] {
        [
            ("aws_endpoint_url", &*self.endpoint),
            ("aws_allow_http", "true"),
            ("aws_access_key_id", USER),
            ("aws_secret_access_key", SECRET),
            ("aws_region", "us-east-1"),
        ]
    }

    /// Where the bucket's objects are.
    pub fn folder(&self) -> &Path {
        self.folder.path()
    }

    /// A remote that wrote `entries` before any fault.
    pub fn filled(&self, map: Map, entries: &[([u8; 32], Vec<u8>)]) -> Remote {
        let remote = self.remote(Policy::ReadWrite);
        for (key, bytes) in entries {
            remote.put(map, *key, bytes.clone());
        }
        assert_eq!(remote.finish(CEILING, |_| true), Vec::<String>::new());
        remote
    }

    /// Closes the port and all connections.
    pub fn kill(&mut self) {
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_timeout(Duration::from_secs(5));
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.kill();
    }
}
