//! Opening the store behind a URL, and reading the errors of its client.

use std::time::Duration;

use object_store::aws::{AmazonS3Builder, AmazonS3ConfigKey};
use object_store::azure::{AzureConfigKey, MicrosoftAzureBuilder};
use object_store::gcp::{GoogleCloudStorageBuilder, GoogleConfigKey};
use object_store::prefix::PrefixStore;
use object_store::{BackoffConfig, ClientConfigKey, ObjectStore, ObjectStoreScheme, RetryConfig};
use url::Url;

/// How long a server may take for its answer, retries included. Buckets answer within tenths of a second; each
/// failure in a row halves it, so that a dead one costs 4 + 2 + 1 seconds even if it is asked for one key at a time.
pub(super) const ANSWER_TIMEOUT: Duration = Duration::from_secs(4);

/// The store behind `url`.
pub(super) fn connect(url: &Url, options: &[(&str, &str)]) -> Result<Box<dyn ObjectStore>, String> {
    // The HTTP client has TLS but no cryptography of its own. That another provider is installed is as good.
    let _ = rustls::crypto::ring::default_provider().install_default();
    // Two retries bridge a hiccup; the first after 100 ms, about a round trip to a far bucket. Longer pauses would
    // only use up the time for the answer.
    let backoff = BackoffConfig { init_backoff: Duration::from_millis(100), ..Default::default() };
    let retry = RetryConfig { backoff, max_retries: 2, retry_timeout: ANSWER_TIMEOUT };
    // Two seconds leave half of the time for the answer. Its own limit for whole requests would cut large blobs
    // short; the deadlines of the requests are stricter where it matters.
    let client = [(ClientConfigKey::ConnectTimeout, "2s"), (ClientConfigKey::Timeout, "1h")];
    // The builders are alike, but share no trait.
    macro_rules! build {
        ($builder:ty, $key:ty, $prefix:ident) => {{
            let mut builder = <$builder>::from_env().with_url(url.as_str()).with_retry(retry);
            for (key, value) in client {
                builder = builder.with_config(<$key>::Client(key), value);
            }
            for (key, value) in options {
                let key: $key = key.parse().map_err(cause_of)?;
                builder = builder.with_config(key, *value);
            }
            let store = builder.build().map_err(cause_of)?;
            Ok(Box::new(PrefixStore::new(store, $prefix)))
        }};
    }
    use ObjectStoreScheme::{AmazonS3, GoogleCloudStorage, MicrosoftAzure};
    match ObjectStoreScheme::parse(url) {
        Ok((AmazonS3, prefix)) => build!(AmazonS3Builder, AmazonS3ConfigKey, prefix),
        Ok((GoogleCloudStorage, prefix)) => build!(GoogleCloudStorageBuilder, GoogleConfigKey, prefix),
        Ok((MicrosoftAzure, prefix)) => build!(MicrosoftAzureBuilder, AzureConfigKey, prefix),
        _ => {
            Err("the URL must be like s3://bucket/prefix, gs://bucket/prefix or az://container/prefix".into())
        }
    }
}

/// Whether the object is not there, rather than its bucket, which would be a mistake in the URL.
pub(super) fn is_missing(error: &object_store::Error) -> bool {
    let text = error.to_string();
    matches!(error, object_store::Error::NotFound { .. })
        && !["NoSuchBucket", "ContainerNotFound"].iter().any(|code| text.contains(code))
}

/// What caused an error, on one line and without URLs and the body of the answer, which may quote credentials.
pub(super) fn cause_of(error: object_store::Error) -> String {
    let mut cause: &dyn std::error::Error = &error;
    while let Some(deeper) = cause.source() {
        cause = deeper;
    }
    let text = cause.to_string();
    // Of an answer only the status and S3's code for what is wrong; anything else with markup is not for people.
    let code = text.split_once("<Code>").and_then(|(_, rest)| rest.split_once("</Code>"));
    let head = match text.strip_prefix("Server returned non-2xx status code: ") {
        Some(answer) => answer.split(':').next(),
        None => text.split(['<', '{']).next(),
    };
    let parts = head.into_iter().chain(code.map(|(code, _)| code));
    let words: Vec<_> = parts.flat_map(str::split_whitespace).filter(|word| !word.contains("://")).collect();
    // Nobody reads more of a warning.
    words.join(" ").chars().take(200).collect()
}
