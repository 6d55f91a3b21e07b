/* SPDX-License-Identifier: BSD-3-Clause
 *
 * Holds the library against the test vectors, then feeds it damaged ones. For sanitizers: every
 * buffer is a heap block of exactly the size that the library is told.
 *
 *     vectors_main FILE ROUNDS
 *
 * A line of FILE is a case; fields are hex, "-" where empty:
 *
 *     packet IHB-COMMAND PAYLOAD PACKET LINE = FRAME...
 *     scan CHANNELS COUNTS = PACKET...
 *     declare CHANNELS PACKET
 *     details PAYLOAD PACKET
 *     frames FRAME... = IHB-COMMAND-PAYLOAD...
 *     serial LINE = IHB-COMMAND-PAYLOAD...
 *     cobs DATA ENCODED
 *     cobs_decode DATA ENCODED
 *     cobs_bad ENCODED
 */
#include <stdio.h>
#include <stdlib.h>

#define TAXELD_PROTOCOL_IMPLEMENTATION
#include "taxeld_protocol.h"

#define TEXT_MAX 65536
#define TOKENS_MAX 256
#define CASES_MAX 256
#define FRAMES_MAX 256

typedef struct {
    uint8_t *data;
    size_t n;
} blob;

typedef struct {
    taxeld_frame frames[FRAMES_MAX];
    size_t n;
} sequence;

static blob lines[CASES_MAX];
static sequence *sequences[CASES_MAX];
static size_t n_lines, n_sequences, line_number;

static void check_at(bool holds, const char *what, int at)
{
    if (holds)
        return;
    fprintf(stderr, "vectors_main.c:%d: vector %lu: not so: %s\n", at, (unsigned long)line_number,
            what);
    exit(1);
}
#define CHECK(condition) check_at((condition), #condition, __LINE__)

static blob block(size_t n)
{
    blob b = {malloc(n ? n : 1), n};

    CHECK(b.data != NULL);
    return b;
}

static blob unhex(const char *text)
{
    blob b = block(text[0] == '-' ? 0 : strlen(text) / 2);

    for (size_t i = 0; i < b.n; i++) {
        const char digits[3] = {text[2 * i], text[2 * i + 1], '\0'};
        char *end;

        b.data[i] = (uint8_t)strtoul(digits, &end, 16);
        CHECK(*end == '\0');
    }
    return b;
}

static bool same(const char *hex, const uint8_t *data, int n)
{
    blob b = unhex(hex);
    const bool equal = n >= 0 && b.n == (size_t)n && memcmp(b.data, data, b.n) == 0;

    free(b.data);
    return equal;
}

/* "101#0203" */
static taxeld_frame frame_of(const char *text)
{
    const char *hash = strchr(text, '#');
    taxeld_frame frame;
    blob data;

    CHECK(hash != NULL && strlen(hash) <= 17);
    data = unhex(hash[1] ? hash + 1 : "-");
    memset(&frame, 0, sizeof frame);
    frame.id = (uint32_t)strtoul(text, NULL, 16);
    frame.extended = hash - text > 3;
    frame.len = (uint8_t)data.n;
    memcpy(frame.data, data.data, data.n);
    free(data.data);
    return frame;
}

static void check_packet(const char *hex, const taxeld_packet *packet)
{
    blob b = unhex(hex);

    CHECK(b.n == packet->n + 2u && b.data[0] == packet->ihb && b.data[1] == packet->command);
    CHECK(memcmp(b.data + 2, packet->payload, packet->n) == 0);
    free(b.data);
}

static void packet_case(char **arg, char **frames, size_t n)
{
    blob head = unhex(arg[0]), payload = unhex(arg[1]), packet = block(payload.n + 3);
    blob line = block(TAXELD_COBS_MAX(payload.n + 5) + 1);
    taxeld_fragmenter fragmenter;
    taxeld_frame frame;
    int len;

    CHECK(taxeld_packet_encode(packet.data, packet.n - 1, head.data[1], payload.data, payload.n) ==
          TAXELD_E_ROOM);
    len = taxeld_packet_encode(packet.data, packet.n, head.data[1], payload.data, payload.n);
    CHECK(same(arg[2], packet.data, len));
    CHECK(taxeld_serial_encode(line.data, line.n - 1, packet.data, packet.n, head.data[0]) ==
          TAXELD_E_ROOM);
    len = taxeld_serial_encode(line.data, line.n, packet.data, packet.n, head.data[0]);
    CHECK(same(arg[3], line.data, len));
    CHECK(taxeld_fragmenter_init(&fragmenter, packet.data, packet.n, head.data[0]) == 0);
    for (size_t i = 0; i < n; i++) {
        const taxeld_frame want = frame_of(frames[i]);

        CHECK(taxeld_fragmenter_next(&fragmenter, &frame));
        CHECK(frame.id == want.id && frame.len == want.len && !frame.extended);
        CHECK(memcmp(frame.data, want.data, want.len) == 0);
    }
    CHECK(!taxeld_fragmenter_next(&fragmenter, &frame));
    free(head.data), free(payload.data), free(packet.data), free(line.data);
}

static void scan_case(char **arg, char **packets, size_t n)
{
    blob channels = unhex(arg[0]), bytes = unhex(arg[1]);
    const size_t values = bytes.n / 2;
    uint16_t *counts = malloc(values ? 2 * values : 1);
    taxeld_scan scan;

    CHECK(counts != NULL);
    for (size_t i = 0; i < values; i++)
        counts[i] = (uint16_t)(bytes.data[2 * i] << 8 | bytes.data[2 * i + 1]);
    CHECK(taxeld_scan_init(&scan, channels.data, channels.n, 0, 0, counts, values + 1) ==
          TAXELD_E_ARGUMENT);
    CHECK(taxeld_scan_init(&scan, channels.data, channels.n, 0, 0, counts, values) == 0);
    for (size_t i = 0; i < n; i++) {
        blob packet = block(strlen(packets[i]) / 2);

        CHECK(taxeld_scan_next(&scan, packet.data, packet.n - 1) == TAXELD_E_ROOM);
        CHECK(same(packets[i], packet.data, taxeld_scan_next(&scan, packet.data, packet.n)));
        free(packet.data);
    }
    CHECK(taxeld_scan_next(&scan, NULL, 0) == 0);
    free(channels.data), free(bytes.data), free(counts);
}

static void answer_case(bool declare, char **arg)
{
    blob in = unhex(arg[0]), packet = block(strlen(arg[1]) / 2);
    const uint8_t *d = in.data;

    if (declare) {
        CHECK(taxeld_declare_encode(packet.data, packet.n - 1, d, in.n) == TAXELD_E_ROOM);
        CHECK(taxeld_declare_encode(packet.data, packet.n, d, in.n) == (int)packet.n);
    } else {
        const taxeld_module module = {
            (uint32_t)d[1] << 24 | (uint32_t)d[2] << 16 | (uint32_t)d[3] << 8 | d[4],
            (uint16_t)(d[7] << 8 | d[8]), d[5], d[6], d[9], d[10],
        };
        CHECK(taxeld_details_encode(packet.data, packet.n - 1, d[0], &module) == TAXELD_E_ROOM);
        CHECK(taxeld_details_encode(packet.data, packet.n, d[0], &module) == (int)packet.n);
    }
    CHECK(same(arg[1], packet.data, (int)packet.n));
    free(in.data), free(packet.data);
}

/* Every hub's reassembler, each in its own block. */
static taxeld_reassembler *hub(size_t short_id)
{
    static taxeld_reassembler *hubs[256];

    if (!hubs[short_id]) {
        hubs[short_id] = malloc(sizeof *hubs[0]);
        CHECK(hubs[short_id] != NULL);
        taxeld_reassembler_init(hubs[short_id], (uint8_t)short_id);
    }
    return hubs[short_id];
}

/* Feed the hub that a frame names; what it holds must stay in its buffer and add up. */
static int feed(const taxeld_frame *frame, taxeld_packet *packet)
{
    taxeld_reassembler *r = hub(frame->id & TAXELD_SHORT_ID_MASK);
    const int status = taxeld_reassembler_feed(r, frame, packet);
    const taxeld_link_counters *c = &r->counters;

    CHECK(r->len <= sizeof r->data && r->pending < TAXELD_FRAGMENTS_MAX);
    CHECK(c->frames == c->used + c->foreign + c->orphan + c->length + c->crc + r->pending);
    if (status == TAXELD_GOOD)
        CHECK(packet->payload == r->data + 2 && packet->n + 3u <= sizeof r->data);
    return status;
}

static void frames_case(char **texts, size_t n, char **delivered, size_t n_delivered)
{
    sequence *s = malloc(sizeof *s);
    size_t got = 0;
    taxeld_packet packet;

    CHECK(s != NULL && n <= FRAMES_MAX);
    for (size_t i = 0; i < 256; i++)
        taxeld_reassembler_init(hub(i), (uint8_t)i);
    for (s->n = 0; s->n < n; s->n++) {
        s->frames[s->n] = frame_of(texts[s->n]);
        if (feed(&s->frames[s->n], &packet) == TAXELD_GOOD) {
            CHECK(got < n_delivered);
            check_packet(delivered[got++], &packet);
        }
    }
    CHECK(got == n_delivered);
    sequences[n_sequences++] = s;
}

static size_t receive(taxeld_receiver *r, const uint8_t *data, size_t n, char **delivered)
{
    taxeld_packet packet;
    size_t got = 0;

    while (taxeld_receiver_take(r, &data, &n, &packet) == TAXELD_GOOD) {
        CHECK(packet.payload == r->line + 3 && packet.n + 5u <= sizeof r->line);
        if (delivered)
            check_packet(delivered[got], &packet);
        got++;
    }
    CHECK(n == 0 && r->len <= sizeof r->line);
    CHECK(r->counters.bytes >= r->counters.used + r->len);
    return got;
}

static void serial_case(char **arg, char **delivered, size_t n)
{
    taxeld_receiver *r = malloc(sizeof *r);
    blob line = unhex(arg[0]);

    CHECK(r != NULL);
    for (size_t piece = 1; piece <= line.n; piece++) {
        size_t got = 0;

        taxeld_receiver_init(r);
        for (size_t at = 0; at < line.n; at += piece)
            got += receive(r, line.data + at, line.n - at < piece ? line.n - at : piece,
                           delivered + got);
        CHECK(got == n);
    }
    free(r);
    lines[n_lines++] = line;
}

static void cobs_case(const char *verb, char **arg)
{
    const bool bad = strcmp(verb, "cobs_bad") == 0;
    blob data = unhex(bad ? "-" : arg[0]), encoded = unhex(bad ? arg[0] : arg[1]);
    blob room = block(TAXELD_COBS_MAX(data.n));

    if (bad) {
        CHECK(taxeld_cobs_decode(encoded.data, encoded.n, encoded.data, encoded.n) ==
              TAXELD_E_COBS);
    } else {
        if (strcmp(verb, "cobs") == 0)
            CHECK(same(arg[1], room.data,
                       taxeld_cobs_encode(room.data, room.n, data.data, data.n)));
        if (data.n)
            CHECK(taxeld_cobs_decode(data.data, data.n - 1, encoded.data, encoded.n) ==
                  TAXELD_E_ROOM);
        CHECK(same(arg[0], data.data,
                   taxeld_cobs_decode(data.data, data.n, encoded.data, encoded.n)));
    }
    free(data.data), free(encoded.data), free(room.data);
}

static void run_case(char *text)
{
    char *token[TOKENS_MAX + 1], **right;
    size_t n = 0, left = 0;

    for (char *t = strtok(text, " \n"); t; t = strtok(NULL, " \n")) {
        CHECK(n < TOKENS_MAX);
        token[n++] = t;
    }
    CHECK(n >= 2 && n_lines < CASES_MAX && n_sequences < CASES_MAX);
    while (left < n && strcmp(token[left], "=") != 0)
        left++;
    right = token + left + 1;
    n -= left < n ? left + 1 : n;
    if (strcmp(token[0], "packet") == 0)
        packet_case(token + 1, right, n);
    else if (strcmp(token[0], "scan") == 0)
        scan_case(token + 1, right, n);
    else if (strcmp(token[0], "frames") == 0)
        frames_case(token + 1, left - 1, right, n);
    else if (strcmp(token[0], "serial") == 0)
        serial_case(token + 1, right, n);
    else if (strncmp(token[0], "cobs", 4) == 0)
        cobs_case(token[0], token + 1);
    else
        answer_case(strcmp(token[0], "declare") == 0, token + 1);
}

static size_t below(size_t n)
{
    static uint32_t state = 0x7A5E1D01u; /* xorshift32: the same damage on every machine */

    state ^= state << 13;
    state ^= state >> 17;
    state ^= state << 5;
    return state % n;
}

static void damaged_frames(void)
{
    const sequence *s = sequences[below(n_sequences)];
    taxeld_packet packet;

    for (size_t i = 0; i < s->n; i++) {
        taxeld_frame frame = s->frames[below(8) ? i : below(s->n)];

        if (!below(8))
            frame.id ^= 1u << below(12);
        if (!below(8))
            frame.len = (uint8_t)below(20);
        if (!below(4))
            frame.data[below(8)] ^= (uint8_t)(1u << below(8));
        frame.extended = !below(50);
        feed(&frame, &packet);
    }
}

/* A damaged line goes to everything that takes bytes. */
static void damaged_line(taxeld_receiver *r)
{
    const blob *line = &lines[below(n_lines)];
    blob bytes = block(below(line->n) + 1), out = block(below(300));
    taxeld_packet packet;

    memcpy(bytes.data, line->data + below(line->n - bytes.n + 1), bytes.n);
    for (size_t i = below(4); i; i--)
        bytes.data[below(bytes.n)] = (uint8_t)(below(3) ? below(256) : 0);
    receive(r, bytes.data, bytes.n, NULL);
    CHECK(taxeld_cobs_encode(out.data, out.n, bytes.data, bytes.n) <= (int)out.n);
    CHECK(taxeld_cobs_decode(out.data, out.n, bytes.data, bytes.n) <= (int)out.n);
    CHECK(taxeld_declare_encode(out.data, out.n, bytes.data, bytes.n) <= (int)out.n);
    taxeld_packet_parse(&packet, bytes.data, bytes.n);
    taxeld_serial_encode(out.data, out.n, bytes.data, bytes.n, 1);
    if (bytes.n > 2) { /* so that parsing gets past the checksum */
        const size_t n = bytes.n < TAXELD_PACKET_MAX ? bytes.n : TAXELD_PACKET_MAX;

        bytes.data[1] = (uint8_t)(n - 3 - below(n - 2 < 8 ? n - 2 : 8));
        bytes.data[bytes.data[1] + 2] = taxeld_crc8(bytes.data, bytes.data[1] + 2u);
        CHECK(taxeld_packet_parse(&packet, bytes.data, n) == TAXELD_GOOD);
        CHECK(taxeld_serial_encode(out.data, out.n, bytes.data, n, 1) <= (int)out.n);
    }
    free(bytes.data), free(out.data);
}

static void any_scan(void)
{
    blob channels = block(below(260)), out = block(below(300));
    const size_t n = below(600);
    uint16_t *counts = malloc(2 * n + 1);
    taxeld_scan scan;

    CHECK(counts != NULL);
    memset(counts, 0xA5, 2 * n);
    for (size_t i = 0; i < channels.n; i++)
        channels.data[i] = (uint8_t)below(below(50) ? 13 : 14);
    taxeld_scan_init(&scan, channels.data, channels.n, below(channels.n + 2), below(14), counts, n);
    while (taxeld_scan_next(&scan, out.data, out.n) > 0)
        CHECK(scan.module <= channels.n);
    free(channels.data), free(out.data), free(counts);
}

/* A payload of any length, with nothing behind it, and answers into any room. */
static void any_request(taxeld_hub *asked)
{
    blob payload = block(below(8)), out = block(below(300));
    const taxeld_packet packet = {TAXELD_BROADCAST, (uint8_t)(TAXELD_DISCOVERY_PING + below(64)),
                                  (uint8_t)payload.n, payload.data};
    int n;

    for (size_t i = 0; i < payload.n; i++)
        payload.data[i] = (uint8_t)(below(3) ? below(256) : 255 * below(2));
    taxeld_hub_hear(asked, &packet);
    while ((n = taxeld_hub_answer(asked, out.data, out.n)) != 0)
        CHECK(n <= (int)out.n);
    free(payload.data), free(out.data);
}

int main(int argc, char **argv)
{
    static char text[TEXT_MAX];
    static taxeld_receiver receiver;
    static taxeld_module modules[TAXELD_MODULES_MAX];
    taxeld_hub asked;
    FILE *file = argc == 3 ? fopen(argv[1], "r") : NULL;

    if (!file) {
        fprintf(stderr, "usage: vectors_main FILE ROUNDS\n");
        return 2;
    }
    while (fgets(text, sizeof text, file)) {
        line_number++;
        run_case(text);
    }
    fclose(file);
    CHECK(n_lines && n_sequences);
    taxeld_hub_init(&asked, 0, modules, below(TAXELD_MODULES_MAX) + 1, TAXELD_BOOTLOADER);
    for (long rounds = atol(argv[2]); rounds > 0; rounds--) {
        damaged_frames();
        damaged_line(&receiver);
        any_scan();
        any_request(&asked);
        asked.phase = (taxeld_phase)below(3);
    }
    printf("%lu vectors\n", (unsigned long)line_number);
    return 0;
}
