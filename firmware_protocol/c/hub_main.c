/* SPDX-License-Identifier: BSD-3-Clause
 *
 * A hub (IHB) built on the library, from its bootloader to its scans: an example of how requests are
 * answered, and what the tests hold against the conversations.
 *
 *     hub_main FILE
 *
 * A line of FILE; fields are hex:
 *
 *     hub UID SHORT-ID PHASE MODULES    PHASE 0: in its bootloader, 2: its modules run; of each
 *                                       module SUI u32, mask u16, channels that DETAILS tell u8
 *     host FRAME...                     the hub hears these
 *     device FRAME...                   and has said these, and nothing before them
 *     scan COUNTS                       its channels read this, once a scan is due
 */
#include <stdio.h>
#include <stdlib.h>

#define TAXELD_PROTOCOL_IMPLEMENTATION
#include "taxeld_protocol.h"

#define TEXT_MAX 65536
#define SAID_MAX 1024

static const uint8_t leave_bootloader[] = {0x01, 0x3B, 0x00, 0x00, 0x4F, 0x6D, 0x17};
#define BOOTLOADER_ID 0x17FFFFFFu /* 29 bits */

static taxeld_module modules[TAXELD_MODULES_MAX];
static taxeld_hub hub;
static taxeld_reassembler own, all;

/* ---- The bus: here a queue that is compared with what should have been said. */

static taxeld_frame said[SAID_MAX];
static size_t n_said, n_checked;
static unsigned long line_number;

static void check_at(bool holds, const char *what, int at)
{
    if (holds)
        return;
    fprintf(stderr, "hub_main.c:%d: line %lu: not so: %s\n", at, line_number, what);
    exit(1);
}
#define CHECK(condition) check_at((condition), #condition, __LINE__)

static void can_send(const taxeld_frame *frame)
{
    CHECK(n_said < SAID_MAX);
    said[n_said++] = *frame;
}

/* ---- The hub. */

static void send(const uint8_t *packet, int len)
{
    taxeld_fragmenter fragments;
    taxeld_frame frame;

    CHECK(len > 0);
    taxeld_fragmenter_init(&fragments, packet, (size_t)len, hub.short_id);
    while (taxeld_fragmenter_next(&fragments, &frame))
        can_send(&frame);
}

static void hear(const taxeld_frame *frame)
{
    uint8_t packet[TAXELD_PACKET_MAX];
    taxeld_packet request;
    int len;

    if (frame->extended && frame->id == BOOTLOADER_ID && frame->len == sizeof leave_bootloader &&
        memcmp(frame->data, leave_bootloader, sizeof leave_bootloader) == 0) {
        if (hub.phase == TAXELD_BOOTLOADER)
            hub.phase = TAXELD_MODULES;
        return;
    }
    if (taxeld_reassembler_feed(&own, frame, &request) != TAXELD_GOOD &&
        taxeld_reassembler_feed(&all, frame, &request) != TAXELD_GOOD)
        return;
    taxeld_hub_hear(&hub, &request);
    while ((len = taxeld_hub_answer(&hub, packet, sizeof packet)) != 0)
        send(packet, len);
    if (hub.short_id != own.short_id)
        taxeld_reassembler_init(&own, hub.short_id);
}

static void scan(const uint16_t *counts, size_t n)
{
    uint8_t packet[TAXELD_PACKET_MAX], channels[TAXELD_MODULES_MAX];
    taxeld_scan state;
    int len;

    CHECK(hub.phase == TAXELD_RUNNING && hub.auto_sync);
    taxeld_channels(channels, modules, hub.modules);
    CHECK(taxeld_scan_init(&state, channels, hub.modules, 0, 0, counts, n) == 0);
    while ((len = taxeld_scan_next(&state, packet, sizeof packet)) > 0)
        send(packet, len);
    CHECK(len == 0);
}

/* ---- The lines. */

static size_t unhex(const char *text, uint8_t *out, size_t room)
{
    const size_t n = strlen(text) / 2;

    CHECK(n <= room);
    for (size_t i = 0; i < n; i++) {
        const char digits[3] = {text[2 * i], text[2 * i + 1], '\0'};

        out[i] = (uint8_t)strtoul(digits, NULL, 16);
    }
    return n;
}

static taxeld_frame frame_of(char *text)
{
    taxeld_frame frame;
    char *hash = strchr(text, '#');

    CHECK(hash != NULL);
    memset(&frame, 0, sizeof frame);
    frame.id = (uint32_t)strtoul(text, NULL, 16);
    frame.extended = hash - text > 3;
    frame.len = (uint8_t)unhex(hash + 1, frame.data, sizeof frame.data);
    return frame;
}

static void begin(char **arg)
{
    uint8_t bytes[7 * TAXELD_MODULES_MAX];
    const size_t n = unhex(arg[3], bytes, sizeof bytes);

    memset(modules, 0, sizeof modules);
    for (size_t i = 0; i < n / 7; i++) {
        const uint8_t *d = bytes + 7 * i;

        modules[i].sui = (uint32_t)d[0] << 24 | (uint32_t)d[1] << 16 | (uint32_t)d[2] << 8 | d[3];
        modules[i].mask = (uint16_t)(d[4] << 8 | d[5]);
        modules[i].channels = d[6];
    }
    taxeld_hub_init(&hub, (uint32_t)strtoul(arg[0], NULL, 16), modules, n / 7,
                    (taxeld_phase)strtoul(arg[2], NULL, 16));
    hub.short_id = (uint8_t)strtoul(arg[1], NULL, 16);
    taxeld_reassembler_init(&own, hub.short_id);
    taxeld_reassembler_init(&all, TAXELD_BROADCAST);
}

static void run(char **arg, size_t n)
{
    if (strcmp(arg[0], "device") == 0) {
        for (size_t i = 1; i < n; i++) {
            const taxeld_frame want = frame_of(arg[i]), *got = &said[n_checked++];

            CHECK(n_checked <= n_said);
            CHECK(got->id == want.id && got->len == want.len && got->extended == want.extended);
            CHECK(memcmp(got->data, want.data, want.len) == 0);
        }
        return;
    }
    if (strcmp(arg[0], "scan") == 0) {
        uint8_t bytes[2 * TAXELD_VALUES_MAX];
        uint16_t counts[TAXELD_VALUES_MAX];
        const size_t values = unhex(arg[1], bytes, sizeof bytes) / 2;

        for (size_t i = 0; i < values; i++)
            counts[i] = (uint16_t)(bytes[2 * i] << 8 | bytes[2 * i + 1]);
        scan(counts, values);
        return;
    }
    CHECK(n_checked == n_said); /* nothing was said that is not in the conversation */
    n_checked = n_said = 0;
    if (strcmp(arg[0], "hub") == 0) {
        CHECK(n == 5);
        begin(arg + 1);
    }
    for (size_t i = 1; i < n && strcmp(arg[0], "host") == 0; i++) {
        const taxeld_frame frame = frame_of(arg[i]);

        hear(&frame);
    }
}

int main(int argc, char **argv)
{
    static char text[TEXT_MAX];
    FILE *file = argc == 2 ? fopen(argv[1], "r") : NULL;

    if (!file) {
        fprintf(stderr, "usage: hub_main FILE\n");
        return 2;
    }
    while (fgets(text, sizeof text, file)) {
        char *arg[256];
        size_t n = 0;

        line_number++;
        for (char *t = strtok(text, " \n"); t; t = strtok(NULL, " \n")) {
            CHECK(n < 256);
            arg[n++] = t;
        }
        if (n)
            run(arg, n);
    }
    fclose(file);
    CHECK(line_number && n_checked == n_said);
    printf("%lu lines\n", line_number);
    return 0;
}
