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

static void whole(int s, char *data, size_t n, int sending) {
    while (n > 0) {
        ssize_t k = sending ? send(s, data, n, MSG_NOSIGNAL) : recv(s, data, n, 0);
        if (k <= 0) { fprintf(stderr, "the run has ended\n"); exit(0); }
        data += k, n -= (size_t)k;
    }
}

/* A frame: its length in 4 bytes, big-endian, and its JSON. */
static void put(int s, char *text) {
    size_t n = strlen(text);
    unsigned char head[4] = {n >> 24, n >> 16, n >> 8, n};
    whole(s, (char *)head, 4, 1);
    whole(s, text, n, 1);
}

static char *get(int s) {
    unsigned char head[4];
    whole(s, (char *)head, 4, 0);
    size_t n = (size_t)head[0] << 24 | head[1] << 16 | head[2] << 8 | head[3];
    char *text = malloc(n + 1);
    if (!text) exit(1);
    whole(s, text, n, 0);
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

int main(int argc, char **argv) {
    char hello[512];
    if (argc < 3) { fprintf(stderr, "usage: %s HOST PORT [TOKEN]\n", argv[0]); return 2; }
    int s = dial(argv[1], argv[2]);
    if (s < 0) { fprintf(stderr, "nothing listens at %s port %s\n", argv[1], argv[2]); return 1; }
    free(get(s)); /* the server's hello */
    snprintf(hello, sizeof hello, "{\"type\":\"hello\",\"protocol\":1,\"name\":\"pendulum.c\"%s%s%s}",
             argc > 3 ? ",\"token\":\"" : "", argc > 3 ? argv[3] : "", argc > 3 ? "\"" : "");
    put(s, hello);
    for (;;) {
        char *message = get(s);
        if (strstr(message, "\"type\":\"work\"")) simulate(s, message);
        else if (strstr(message, "\"type\":\"error\"")) fprintf(stderr, "%s\n", message);
        free(message);
    }
}
