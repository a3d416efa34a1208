/* A simulator in C that answers a verifai_jax run: a damped pendulum, 200 samples of 20 ms.
 *
 *   gcc -O2 -Wall -Werror -o pendulum examples/remote/pendulum.c -lm
 *   ./pendulum 127.0.0.1 4567 [token]
 *
 * docs/remote.md has the protocol. With a capacity of 1 there is one point in every message, so
 * that finding a name in its text is parser enough; a simulator with more features wants a JSON
 * library.
 */
#include <math.h>
#include <netdb.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#define SAMPLES 200
#define DT 0.02
#define MOST (1 << 20) /* Bytes of a message. */

static int dial(const char *host, const char *port) {
    struct addrinfo hints = {.ai_socktype = SOCK_STREAM}, *found, *a;
    int s = -1;
    if (getaddrinfo(host, port, &hints, &found)) return -1;
    for (a = found; a && s < 0; a = a->ai_next) {
        s = socket(a->ai_family, a->ai_socktype, a->ai_protocol);
        if (s >= 0 && connect(s, a->ai_addr, a->ai_addrlen)) { close(s); s = -1; }
    }
    freeaddrinfo(found);
    return s;
}

/* Whether all of it was sent or received. */
static int whole(int s, char *data, size_t n, int sending) {
    while (n > 0) {
        ssize_t k = sending ? send(s, data, n, MSG_NOSIGNAL) : recv(s, data, n, 0);
        if (k <= 0) return 0;
        data += k, n -= (size_t)k;
    }
    return 1;
}

/* A frame: its length in 4 bytes, big-endian, and its JSON. */
static void put(int s, char *text) {
    size_t n = strlen(text);
    unsigned char head[4] = {n >> 24, n >> 16, n >> 8, n};
    if (whole(s, (char *)head, 4, 1)) whole(s, text, n, 1);
}

/* The next message, until the one after it; NULL where the connection has ended. */
static char *get(int s) {
    static char text[MOST + 1];
    unsigned char head[4];
    if (!whole(s, (char *)head, 4, 0)) return NULL;
    size_t n = (size_t)head[0] << 24 | head[1] << 16 | head[2] << 8 | head[3];
    if (n > MOST) {
        fprintf(stderr, "no run of verifai_jax: it announces %zu bytes\n", n);
        exit(1);
    }
    if (!whole(s, text, n, 0)) return NULL;
    text[n] = 0;
    return text;
}

static double number(const char *text, const char *name) {
    char key[64];
    snprintf(key, sizeof key, "\"%s\":", name);
    const char *at = strstr(text, key);
    return at ? strtod(at + strlen(key), NULL) : NAN;
}

static void simulate(int s, const char *point) {
    static char text[SAMPLES * 60 + 200];
    double theta[SAMPLES], omega[SAMPLES];
    double angle = number(point, "theta0"), rate = 0, length = number(point, "length");
    if (!(number(point, "id") >= 0 && number(point, "id") < 1e15)) {
        fprintf(stderr, "no run of verifai_jax: it sends a point without an id\n");
        exit(1);
    }
    if (isnan(angle) || !(length > 0)) {
        snprintf(text, sizeof text, "{\"type\":\"result\",\"id\":%.0f,"
                 "\"error\":\"the pendulum needs theta0 and length\"}", number(point, "id"));
        put(s, text);
        return;
    }
    for (int k = 0; k < SAMPLES; k++) {
        theta[k] = angle, omega[k] = rate;
        rate += DT * (-9.81 / length * sin(angle) - 0.1 * rate);
        angle += DT * rate;
    }
    int n = sprintf(text, "{\"type\":\"result\",\"id\":%.0f,\"dt\":%g,\"signals\":{\"theta\":[",
                    number(point, "id"), DT);
    for (int k = 0; k < SAMPLES; k++) n += sprintf(text + n, k ? ",%.9g" : "%.9g", theta[k]);
    n += sprintf(text + n, "],\"omega\":[");
    for (int k = 0; k < SAMPLES; k++) n += sprintf(text + n, k ? ",%.9g" : "%.9g", omega[k]);
    sprintf(text + n, "]}}");
    put(s, text);
}

/* Simulate until the connection ends; whether it is worth trying again, as the run had no room. */
static int serve(int s, const char *token) {
    char hello[512], *message = get(s);
    snprintf(hello, sizeof hello, "{\"type\":\"hello\",\"protocol\":1,\"name\":\"pendulum.c\"%s%s%s}",
             token ? ",\"token\":\"" : "", token ? token : "", token ? "\"" : "");
    if (!message) return 1; /* Dropped before it could say hello. */
    if (strstr(message, "\"type\":\"hello\"")) {
        put(s, hello);
        message = get(s);
    }
    for (; message; message = get(s)) {
        if (strstr(message, "\"type\":\"work\"")) simulate(s, message);
        else if (strstr(message, "\"type\":\"error\"")) {
            for (char *c = message; *c; c++) if (*c < 32 || *c > 126) *c = ' ';
            fprintf(stderr, "%.300s\n", message);
            if (strstr(message, "\"retry\":true")) return 1;
        }
    }
    return 0;
}

int main(int argc, char **argv) {
    if (argc < 3) { fprintf(stderr, "usage: %s HOST PORT [TOKEN]\n", argv[0]); return 2; }
    for (int again = 1, tries = 0; again; sleep(again), tries++) {
        int s = dial(argv[1], argv[2]);
        if (s < 0 && tries > 0) break;
        if (s < 0) { fprintf(stderr, "nothing listens at %s port %s\n", argv[1], argv[2]); return 1; }
        again = serve(s, argc > 3 ? argv[3] : NULL);
        close(s);
    }
    fprintf(stderr, "the run has ended\n");
    return 0;
}
